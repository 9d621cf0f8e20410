from __future__ import annotations

from dataclasses import replace

import pytest

from hiersched.runs import paths
from hiersched.runs.variants import (
    SWEPT_KEYS,
    check_variants,
    design_of,
    gain_designs,
    group_policies,
    study_scenario,
    swept_scenario,
    swept_values,
    value_text,
)
from hiersched.scenario import Scenario, ScenarioError, scenario_to_dict


@pytest.mark.parametrize(
    ("value", "text"), [(0.005, "0.005"), (1.0, "1"), (0.1 + 0.2, "0.3"), ("zigzag", "zigzag")]
)
def test_value_text(value: float | str, text: str) -> None:
    assert value_text(value) == text


@pytest.mark.parametrize("axis", list(SWEPT_KEYS))
def test_a_sweep_changes_one_key(tiny: Scenario, axis: str) -> None:
    value = swept_values(tiny, axis)[-1]
    section, key = SWEPT_KEYS[axis].split(".")
    expected = scenario_to_dict(tiny)
    expected[section][key] = value
    assert scenario_to_dict(swept_scenario(tiny, axis, value)) == expected


def test_unknown_axis(tiny: Scenario) -> None:
    with pytest.raises(ValueError, match="axis = 'speed': must be one of rayleigh_scale"):
        swept_values(tiny, "speed")


def test_a_swept_value_must_fit(tiny: Scenario) -> None:
    """0.03 s is a multiple of the substep, as the scenario asks, but does not divide a window."""
    scenario = replace(tiny, sweeps=replace(tiny.sweeps, sampling_s=(0.02, 0.03)))
    with pytest.raises(
        ScenarioError, match=r"sweeps.sampling_s = 0.03: robot.window_s = 1.0: must be"
    ):
        check_variants(scenario)
    check_variants(tiny)


def test_designs(tiny: Scenario) -> None:
    assert list(gain_designs(tiny)) == ["schedule", "schedule_0.04", "schedule_razumikhin"]
    assert design_of(tiny, swept_scenario(tiny, "sampling_s", 0.02)) == "schedule"
    assert design_of(tiny, swept_scenario(tiny, "sampling_s", 0.04)) == "schedule_0.04"
    assert design_of(tiny, study_scenario(tiny, "krasovskii", "nominal")) == "schedule"
    assert design_of(tiny, study_scenario(tiny, "razumikhin", "adjusted")) == "schedule_razumikhin"
    with pytest.raises(ValueError, match="no gain schedule"):
        design_of(tiny, replace(tiny, control=replace(tiny.control, weight=1.0)))


def test_groups(tiny: Scenario) -> None:
    assert group_policies(tiny.evaluate.policies, "classical") == ("pf", "edf")
    assert group_policies(tiny.evaluate.policies, "ddpg") == ("ddpg",)


def test_no_two_logs_share_a_path(tiny: Scenario) -> None:
    names = [
        *paths.training_logs(tiny),
        *paths.policy_files(tiny),
        *paths.gain_study_logs(tiny),
        *paths.all_gain_files(tiny),
        *(name for group in ("classical", "ddpg") for name in paths.evaluation_logs(tiny, group)),
        *(
            name
            for axis in SWEPT_KEYS
            for group in ("classical", "ddpg")
            for name in paths.sweep_logs(tiny, axis, group)
        ),
    ]
    assert len(set(names)) == len(names) == 2 + 2 + 8 + 3 + 9 + 12
