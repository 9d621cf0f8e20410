"""What the simulator refuses, and that the message says what, the value and what is allowed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hiersched.core.randomness import world_keys
from hiersched.policies.policy import LoggedDecisions
from hiersched.simulator.loop_gains import Gains


def test_unknown_policy(make_simulator):
    with pytest.raises(ValueError, match=r"policy = 'best': must be one of pf, pf_average, .*edf"):
        make_simulator().run("best")


@pytest.mark.parametrize("num_slots", [0, -1, 61])
def test_slots_beyond_the_horizon(make_simulator, num_slots):
    with pytest.raises(ValueError, match=rf"num_slots = {num_slots}: must be 1 to 60"):
        make_simulator().run("pf", num_slots)


def test_slots_after_the_horizon(make_simulator):
    simulator = make_simulator()
    simulator.run("pf")
    with pytest.raises(ValueError, match="num_slots = 1: must be 1 to 0"):
        simulator.run("pf", 1)


@pytest.mark.parametrize(
    "weights",
    [np.ones((2, 7)), np.ones(8), np.zeros((2, 8)), np.full((2, 8), np.nan), -np.ones((2, 8))],
)
def test_weights(make_simulator, weights):
    with pytest.raises(ValueError, match=r"weights: must be positive and finite, shape \(2, 8\)"):
        make_simulator().run("pf", weights=weights)


def test_record_of_another_shape(make_simulator):
    simulator = make_simulator()
    with pytest.raises(ValueError, match=r"record: \(2, 5\) .* must be \(2, 6\)"):
        simulator.run("pf", 6, record=simulator.new_record(5))


def test_record_of_another_scenario(make_simulator):
    other = make_simulator(radio={"num_prb": 12}).new_record(6)
    with pytest.raises(ValueError, match=r"record: rows of \d+ words, must be \d+ \(it is of anot"):
        make_simulator().run("pf", 6, record=other)


def test_number_of_worlds(make_simulator):
    with pytest.raises(ValueError, match="3 worlds, must be 2"):
        make_simulator().reset(world_keys("test", 1, 3))


def test_gains_of_another_horizon(make_simulator, smoke_scenario):
    needed = smoke_scenario.max_delay_steps + 1
    for local, network, name in ((needed, 2, "network"), (needed + 1, needed, "local")):
        gains = replace(
            Gains.memoryless(np.zeros((needed, 2, 5))),
            local_gains=np.zeros((local, 2, 5)),
            network_gains=np.zeros((network, 2, 5)),
        )
        with pytest.raises(ValueError, match=rf"{name}_gains: shape .* must be \({needed}, 2, 5\)"):
            make_simulator(gains=gains)


def test_arrivals_beyond_the_quantile(make_simulator):
    message = r"traffic\.load = 0\.95: up to 1045 batches a slot and user .* must stay within 600"
    with pytest.raises(ValueError, match=message):
        make_simulator(
            traffic={
                "embb_offered_mbps": (1.0, 1.0, 1.0, 1100.0),
                "arrivals": {"batch_packets": 1},
                "load": 0.95,
            }
        )


@pytest.mark.parametrize(
    ("delays", "message"),
    [
        (np.zeros((2, 5, 3)), r"network_delay_s: shape \(2, 5, 3\), must be \(2, 5, 4\)"),
        (np.full((2, 5, 4), -0.1), "network_delay_s: must be finite and not negative"),
        (np.full((2, 5, 4), np.nan), "network_delay_s: must be finite and not negative"),
        (np.zeros((2, 61, 4)), "network_delay_s: 61 slots, at most 60"),
    ],
)
def test_forced_delays(make_simulator, delays, message):
    with pytest.raises(ValueError, match=message):
        make_simulator().run_robots(delays)


def test_owners_must_be_an_allocation(make_simulator):
    simulator = make_simulator()
    good = make_simulator().run("pf").prb_owner
    for bad, message in (
        (good[:, :, :-1], "shape"),
        (np.zeros_like(good), "every user"),
        (np.where(good == 0, simulator.scenario.num_users, good), "every user"),
    ):
        with pytest.raises(ValueError, match=message):
            simulator.run(LoggedDecisions(bad))
    beyond = np.repeat(good, 2, axis=1)
    with pytest.raises(ValueError, match="num_slots"):
        simulator.run(LoggedDecisions(beyond))
