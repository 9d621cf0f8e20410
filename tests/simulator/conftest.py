from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hiersched.core.randomness import world_keys
from hiersched.models.plant.unicycle import LANES
from hiersched.simulator import Simulator


def vary(thing, values):
    """Replace values, in sections and models as well: vary(scenario, {"radio": {"num_prb": 7}})."""
    return replace(
        thing,
        **{
            name: vary(getattr(thing, name), new) if isinstance(new, dict) else new
            for name, new in values.items()
        },
    )


@pytest.fixture(scope="session")
def make_simulator(smoke_scenario, nominal_gains):
    """Simulator of the smoke scenario at full load, with the given values replaced."""

    def make(num_envs=2, num_slots=60, *, keys=None, gains=None, **sections):
        scenario = vary(smoke_scenario, sections)
        return Simulator(
            scenario,
            nominal_gains(scenario) if gains is None else gains,
            world_keys("test", 1, num_envs) if keys is None else np.asarray(keys, np.uint64),
            num_slots,
        )

    return make


@pytest.fixture(scope="session")
def assert_same_bits():
    """Compare all fields, or the named ones, of two records as bytes."""

    def check(got, expected, names=None):
        for name in names or got._fields:
            one, other = getattr(got, name), getattr(expected, name)
            assert one.shape == other.shape, name
            assert one.tobytes() == other.tobytes(), name

    return check


@pytest.fixture(scope="session")
def of_robots():
    """Copy a field of all unicycles of a simulator, such as STATE with 5 values: (E, R, count)."""

    def read(simulator, start, count):
        words = simulator.words["plant"]
        robots = [divmod(robot, LANES) for robot in range(words.operator.offset.shape[1])]
        return np.stack(
            [
                words.lanes[:, block, start + lane : start + count * LANES : LANES]
                for block, lane in robots
            ],
            axis=1,
        )

    return read
