"""Features from the kernels against the formulas in NumPy, in double throughout."""

from __future__ import annotations

import numpy as np
import pytest

from hiersched.core.pointer import Pointer
from hiersched.policies.features import (
    DEMAND_FEATURES,
    FEATURES,
    MULTIPLIER,
    ROBOT_FEATURES,
    multiplier_feature,
    num_features,
    observe_worlds,
)


def observe(constants, state, *, observe_robots=False, observe_demand=False):
    observed = observe_robots, observe_demand
    features = np.full((*state.backlog_packets.shape, num_features(*observed)), np.nan, np.float32)
    observe_worlds(Pointer(constants), Pointer(state), *observed, features)
    return features


def formulas(constants, state):
    """Every feature by its name, (E, U) or (E, R)."""
    rate = state.reported_rate_mbps.astype(np.float64).mean(axis=2)
    packets = rate * constants.service_packets_per_mbps
    need = state.backlog_packets / packets
    loop, robots = constants.loop, constants.num_urllc
    delay_s = state.hol_delay_s[:, :robots] + loop.core_latency_s
    steps = np.ceil(delay_s / loop.sampling_s - 1e-9)
    position = state.robot_state[..., :2]
    due = constants.mean_due_packets[:robots]
    return {
        "need": need / 4.0,
        "log_need": np.log1p(need),
        "log_wait": np.log1p(state.hol_delay_s / constants.deadline_s),
        "log_prb_rate": np.log(rate / 10.0),
        "served": state.rate_mbps / rate / 4.0,
        "dexterity": state.dexterity_index,
        "log_multiplier": np.log1p(state.multiplier),
        "load": constants.mean_due_packets / packets / 4.0,
        "log_tracking_error": np.log1p(100.0 * np.hypot(position[..., 0], position[..., 1])),
        "delay_steps": np.minimum(steps, loop.max_delay_steps) / loop.max_delay_steps,
        "gain_delay_steps": state.gain_delay_steps / loop.max_delay_steps,
        "log_set_point_speed": np.log1p(20.0 * state.set_point_speed_mps**2),
        "log_set_point_gap": np.log1p(100.0 * state.set_point_gap_m),
        "log_set_point_acceleration": np.log1p(state.set_point_acceleration_mps2),
        "log_set_point_age": np.log1p(state.set_point_age_s / constants.deadline_s[:robots]),
        "log_reported_error": np.log1p(100.0 * state.reported_error_m),
        "log_rarity": np.broadcast_to(np.log(due.mean() / due), position.shape[:2]),
    }


@pytest.mark.parametrize("observe_robots", [False, True])
@pytest.mark.parametrize("observe_demand", [False, True])
@pytest.mark.parametrize(("num_urllc", "num_embb", "num_prb"), [(10, 10, 25), (3, 7, 9), (5, 1, 1)])
def test_features_follow_their_formulas(
    make_worlds, num_urllc, num_embb, num_prb, observe_robots, observe_demand
):
    constants, state = make_worlds(num_urllc, num_embb, num_prb=num_prb, num_envs=20)
    constants = constants._replace(service_packets_per_mbps=0.7)
    got = observe(constants, state, observe_robots=observe_robots, observe_demand=observe_demand)
    names = FEATURES + (ROBOT_FEATURES if observe_robots else ())
    names += DEMAND_FEATURES if observe_demand else ()
    assert got.shape[2] == len(names)
    for place, name in enumerate(names):
        wanted = formulas(constants, state)[name].astype(np.float32)
        users = wanted.shape[1]
        np.testing.assert_array_max_ulp(got[:, :users, place], wanted, maxulp=1)
        assert (got[:, users:, place] == 0.0).all(), name


def test_steps_of_delay_at_their_edges(make_worlds):
    """A delay of whole steps counts as so many; what goes beyond the largest counts as it."""
    constants, state = make_worlds(5, 1, num_envs=1)
    state.hol_delay_s[0, :5] = [0.0, 0.015, 0.0151, 0.075, 99.0]  # 0.005 more in the core
    steps = 6.0 * observe(constants, state, observe_robots=True)[0, :5, 9]
    np.testing.assert_allclose(steps, [1.0, 1.0, 2.0, 4.0, 6.0], rtol=1e-6)


def test_a_multiplier_appears_the_same_outside_a_world(make_worlds):
    constants, state = make_worlds(num_envs=30)
    got = observe(constants, state)[:, : constants.num_urllc, MULTIPLIER]
    np.testing.assert_array_equal(got, multiplier_feature(state.multiplier))
    np.testing.assert_array_equal(got[:, ::2], multiplier_feature(state.multiplier[:, ::2]))


@pytest.mark.parametrize("num_envs", [1, 3])
def test_a_world_has_the_same_features_in_every_batch(make_worlds, num_envs):
    every = {"observe_robots": True, "observe_demand": True}
    many = observe(*make_worlds(num_envs=64), **every)
    few = observe(*make_worlds(num_envs=num_envs), **every)
    assert few.tobytes() == many[:num_envs].tobytes()


EXTREMES = {
    "empty": {"backlog_packets": 0.0, "hol_delay_s": 0.0, "rate_mbps": 0.0, "multiplier": 0.0},
    "overloaded": {"backlog_packets": 1e15, "hol_delay_s": 1e9, "multiplier": 1e12},
    "no rate": {"reported_rate_mbps": 0.0},
    "no rate, overloaded": {"reported_rate_mbps": 0.0, "backlog_packets": 1e15},
    "deep fade": {"reported_rate_mbps": 1e-30, "rate_mbps": 1e6},
    "strong": {"reported_rate_mbps": 1e30, "backlog_packets": 1e-300},
    "far off": {"robot_state": 1e100, "gain_delay_steps": 0},
    "without end": {"set_point_speed_mps": 1e100, "set_point_gap_m": 1e100, "set_point_age_s": 1e9},
}


@pytest.mark.parametrize("name", EXTREMES)
def test_features_are_finite_at_extremes(make_worlds, name):
    constants, state = make_worlds()
    for field, value in EXTREMES[name].items():
        getattr(state, field)[...] = value
    assert np.isfinite(observe(constants, state, observe_robots=True, observe_demand=True)).all()


def test_a_user_without_load_is_rare_and_no_more(make_worlds):
    constants, state = make_worlds()
    constants.mean_due_packets[:2] = 0.0
    rarity = observe(constants, state, observe_demand=True)[0, :, -1]
    assert np.isfinite(rarity).all()
    assert rarity[0] == rarity[1] > rarity[2:10].max()
