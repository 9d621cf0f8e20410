"""Gains that the package ships, and those that it does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hiersched.scenario import load_scenario
from hiersched.scenario.plugins import CONFIG
from hiersched.simulator.gain_source import (
    SHIPPED,
    design_schedule,
    scenario_gains,
    scenario_schedule,
    shipped_file,
)
from hiersched.simulator.loop_gains import plant_of

SCENARIOS = sorted(path.stem for path in (CONFIG / "scenarios").glob("*.yaml"))


def with_control(scenario, **values):
    return replace(scenario, control=replace(scenario.control, **values))


def test_every_shipped_scenario_has_its_gains_and_no_others_are_there():
    """`make gains` writes them."""
    assert {shipped_file(load_scenario(name)) for name in SCENARIOS} == set(SHIPPED.iterdir())


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["smoke", "linear_plant"])
def test_shipped_gains_are_those_that_the_design_gives(name):
    """`make gains` writes them.

    The minimum is flat: on another processor the solver ends elsewhere in it, by 1 % in an entry.
    """
    scenario = load_scenario(name)
    shipped, now = scenario_schedule(scenario), design_schedule(scenario)
    assert shipped.status == now.status
    np.testing.assert_allclose(shipped.gains, now.gains, rtol=0.03, atol=0.01)
    np.testing.assert_allclose(shipped.deviation, now.deviation, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(shipped.nominal, now.nominal, rtol=1e-9, atol=1e-12)
    shipped.verify(plant_of(scenario))


def test_what_no_design_reads_leaves_the_gains_as_they_are():
    smoke = load_scenario("smoke")
    busy = replace(smoke, traffic=replace(smoke.traffic, load=1.2))
    assert shipped_file(busy) == shipped_file(smoke)
    assert scenario_gains(with_control(smoke, gain="nominal")).adjusted.any() == np.False_


@pytest.mark.parametrize("values", [{"weight": 100.0}, {"max_delay_s": 0.1}, {"method": "h2"}])
def test_another_design_is_another_file(values):
    smoke = load_scenario("smoke")
    assert shipped_file(with_control(smoke, **values)) != shipped_file(smoke)


def test_gains_that_are_not_shipped_are_designed():
    scenario = with_control(load_scenario("smoke"), weight=100.0, max_delay_s=0.02)
    schedule = scenario_schedule(scenario)
    assert schedule.max_delay_steps == 1
    schedule.verify(plant_of(scenario))
