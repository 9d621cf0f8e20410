"""What a policy sees of each user: dimensionless numbers that mean the same in every cell.

Environments, training and policies all read these. A change in a feature's meaning raises
`FEATURE_VERSION`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.core.compiled import inner_kernel, kernel
from hiersched.core.numerics import F32, fma, ln_f64, log1p_f64

FEATURE_VERSION = 1
"""Rises when a feature changes its meaning: a policy runs only on the version it has learnt."""

FEATURES = (
    "need",  # PRBs that would empty the queue at the coming slot's mean rate, / NEED_SCALE
    "log_need",  # ln(1 + the same, unscaled)
    "log_wait",  # ln(1 + head-of-line delay / deadline)
    "log_prb_rate",  # ln of the coming slot's mean PRB rate over 10 Mbit/s
    "served",  # rate of the last slot over the coming slot's mean PRB rate, / NEED_SCALE
    "dexterity",  # DI in force (0 for eMBB users)
    "log_multiplier",  # ln(1 + multiplier of the user's delay constraint) (0 for eMBB users)
    "load",  # PRBs that the user's offered load takes at the coming slot's mean rate, / NEED_SCALE
)
"""Names of the features of one user, in order."""

ROBOT_FEATURES = (
    "log_tracking_error",  # ln(1 + present position error in cm)
    "delay_steps",  # delay of the feedback, were the head packet delivered now, over the largest
    "gain_delay_steps",  # delay whose adjusted gain is in force over the largest; 0: nominal gain
)
"""Further features of a URLLC user where robots are observed (0 for eMBB users)."""

DEMAND_FEATURES = (
    "log_set_point_speed",  # ln(1 + v^2 / (0.05 m^2/s^2)), v the speed of the newest set-point
    "log_set_point_gap",  # ln(1 + distance of the newest and the held set-point in cm)
    "log_set_point_acceleration",  # ln(1 + acceleration of the newest set-point in m/s^2)
    "log_set_point_age",  # ln(1 + age of the held set-point / deadline)
    "log_reported_error",  # ln(1 + position error as last reported in cm)
    "log_rarity",  # ln of the slice's mean packets a slot over the user's own
)
"""Further features of a URLLC user where the demand of its robot's task is observed.

They follow those of the robots and are 0 for eMBB users. The logarithm of a control cost
(v_0^2 + v^2) / packets^2 is linear in them.
"""
SPEED_FLOOR_M2PS2 = 0.05
"""v_0^2 of v_0^2 + v^2, which a robot at speed v asks for: one that stands asks for something."""
MULTIPLIER = FEATURES.index("log_multiplier")
NEED_SCALE = 4.0
_NUM_FEATURES = len(FEATURES)
_REFERENCE_RATE_MBPS = 10.0
_LEAST_RATE_MBPS = 1e-9
"""Taken for a mean rate below it: features stay finite where the report says no rate at all."""
LEAST_PACKETS = 1e-3
"""Packets a slot, taken for fewer where a user's are compared with the slice's."""


def num_features(observe_robots: bool, observe_demand: bool) -> int:
    """Features of one user."""
    robots = len(ROBOT_FEATURES) if observe_robots else 0
    return _NUM_FEATURES + robots + (len(DEMAND_FEATURES) if observe_demand else 0)


def multiplier_feature(multipliers: NDArray[np.float64]) -> NDArray[np.float32]:
    """ln(1 + multiplier), same shape: how a multiplier appears among the features."""
    feature = np.empty(multipliers.shape, np.float32)
    _multiplier_features(np.ravel(multipliers), feature.reshape(-1))
    return feature


@kernel()
def _multiplier_features(multipliers: Any, features: Any) -> None:
    for i in range(features.shape[0]):
        features[i] = F32(log1p_f64(multipliers[i]))


@kernel()
def observe_worlds(
    constants: Any, state: Any, observe_robots: bool, observe_demand: bool, features: Any
) -> None:
    """Fill the features of every user of every world at the start of the coming slot.

    `constants` and `state` are pointers to those of a simulator, read only. `features` has shape
    (E, U, num_features(observe_robots, observe_demand)), float32, URLLC users first. Slice means
    are not among them: the networks form them.
    """
    for env in range(features.shape[0]):
        observe_world(constants, state, env, observe_robots, observe_demand, features[env])


@inner_kernel()
def observe_world(
    constants: Any,
    state: Any,
    env: int,
    observe_robots: bool,
    observe_demand: bool,
    features: Any,
) -> None:
    """Fill the features (U, F) of one world, as `observe_worlds` does."""
    for user in range(features.shape[0]):
        rate_mbps = max(_mean(state.reported_rate_mbps[env, user]), _LEAST_RATE_MBPS)
        packets_per_prb = rate_mbps * constants.service_packets_per_mbps
        need = state.backlog_packets[env, user] / packets_per_prb
        row = features[user]
        row[0] = F32(need / NEED_SCALE)
        row[1] = F32(log1p_f64(need))
        row[2] = F32(log1p_f64(state.hol_delay_s[env, user] / constants.deadline_s[user]))
        row[3] = F32(ln_f64(rate_mbps / _REFERENCE_RATE_MBPS))
        row[4] = F32(state.rate_mbps[env, user] / rate_mbps / NEED_SCALE)
        row[7] = F32(constants.mean_due_packets[user] / packets_per_prb / NEED_SCALE)
        row[5] = row[MULTIPLIER] = F32(0.0)
        for feature in range(_NUM_FEATURES, features.shape[1]):
            row[feature] = F32(0.0)
    for robot in range(constants.num_urllc):
        features[robot, 5] = F32(state.dexterity_index[env, robot])
        features[robot, MULTIPLIER] = F32(log1p_f64(state.multiplier[env, robot]))
    if observe_robots:
        _observe_robots(constants, state, env, features)
    if observe_demand:
        first = features.shape[1] - len(DEMAND_FEATURES)
        _observe_demand(constants, state, env, features[:, first:])


@inner_kernel()
def _observe_robots(constants: Any, state: Any, env: int, features: Any) -> None:
    """Fill ROBOT_FEATURES of the URLLC users; the delay as the robots' loop forms it."""
    loop = constants.loop
    largest = max(np.float64(loop.max_delay_steps), 1.0)  # 0 of a loop that knows no delay
    for robot in range(constants.num_urllc):
        x, y = state.robot_state[env, robot, 0], state.robot_state[env, robot, 1]
        distance_m = np.sqrt(fma(x, x, y * y))
        delay_s = state.hol_delay_s[env, robot] + loop.core_latency_s
        steps = np.ceil(delay_s / loop.sampling_s - 1e-9)
        row = features[robot]
        row[_NUM_FEATURES] = F32(log1p_f64(100.0 * distance_m))
        row[_NUM_FEATURES + 1] = F32(min(steps, largest) / largest)
        row[_NUM_FEATURES + 2] = F32(np.float64(state.gain_delay_steps[env, robot]) / largest)


@inner_kernel()
def _observe_demand(constants: Any, state: Any, env: int, features: Any) -> None:
    """Fill DEMAND_FEATURES, shape (U, 6), of the URLLC users."""
    num_urllc, mean_packets = constants.num_urllc, 0.0
    for robot in range(num_urllc):
        mean_packets += max(constants.mean_due_packets[robot], LEAST_PACKETS) / num_urllc
    for robot in range(num_urllc):
        row, speed_mps = features[robot], state.set_point_speed_mps[env, robot]
        age_s = state.set_point_age_s[env, robot]
        packets = max(constants.mean_due_packets[robot], LEAST_PACKETS)
        row[0] = F32(log1p_f64(speed_mps * speed_mps / SPEED_FLOOR_M2PS2))
        row[1] = F32(log1p_f64(100.0 * state.set_point_gap_m[env, robot]))
        row[2] = F32(log1p_f64(state.set_point_acceleration_mps2[env, robot]))
        row[3] = F32(log1p_f64(age_s / constants.deadline_s[robot]))
        row[4] = F32(log1p_f64(100.0 * state.reported_error_m[env, robot]))
        row[5] = F32(ln_f64(mean_packets / packets))


@njit(inline="always")
def _mean(values: Any) -> Any:
    """Mean of float32 values in double, as four interleaved sums."""
    a = b = c = d = 0.0
    whole = values.shape[0] - values.shape[0] % 4
    for i in range(0, whole, 4):
        a += np.float64(values[i])
        b += np.float64(values[i + 1])
        c += np.float64(values[i + 2])
        d += np.float64(values[i + 3])
    for i in range(whole, values.shape[0]):
        a += np.float64(values[i])
    return ((a + c) + (b + d)) / np.float64(values.shape[0])
