"""What an agent sees of each user: dimensionless numbers that mean the same in every cell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hiersched.models.plant.unicycle import STATE
from hiersched.policies.features import (
    FEATURE_VERSION,
    FEATURES,
    MULTIPLIER,
    NEED_SCALE,
    ROBOT_FEATURES,
    multiplier_feature,
    num_features,
)
from hiersched.simulator import Simulator

__all__ = [
    "FEATURES",
    "FEATURE_VERSION",
    "MULTIPLIER",
    "NEED_SCALE",
    "ROBOT_FEATURES",
    "agent_views",
    "multiplier_feature",
    "num_features",
    "user_features",
]

_REFERENCE_RATE_MBPS = 10.0


def user_features(
    simulator: Simulator, multipliers: NDArray[np.float64], *, observe_robots: bool = False
) -> NDArray[np.float32]:
    """Features of every user at the start of the coming slot.

    Parameters
    ----------
    simulator
        Its state is read, not changed.
    multipliers
        Multiplier of each URLLC user's delay constraint, shape (E, R).
    observe_robots
        Whether ROBOT_FEATURES follow.

    Returns
    -------
    features
        Shape (E, U, num_features(observe_robots)), URLLC users first. Slice means are
        not among them: the networks form them.
    """
    constants, state = simulator.constants, simulator.state
    num_urllc = constants.num_urllc
    # Four times as fast as the method `mean` on so short an axis.
    rate_mbps = np.einsum("euk->eu", state.prb_rate_mbps) / np.float32(constants.num_prb)
    packets_per_prb = rate_mbps * constants.service_packets_per_mbps
    need = state.backlog_packets / packets_per_prb
    deadline_s = constants.deadline_slots * constants.slot_s
    features = np.zeros((*rate_mbps.shape, num_features(observe_robots)), np.float32)
    features[..., 0] = need / NEED_SCALE
    features[..., 1] = np.log1p(need)
    features[..., 2] = np.log1p(state.hol_delay_s / deadline_s)
    features[..., 3] = np.log(rate_mbps / _REFERENCE_RATE_MBPS)
    features[..., 4] = state.rate_mbps / rate_mbps / NEED_SCALE
    features[:, :num_urllc, 5] = state.robots.dexterity_index
    features[:, :num_urllc, MULTIPLIER] = multiplier_feature(multipliers)
    features[..., 7] = constants.mean_due_packets / packets_per_prb / NEED_SCALE
    if observe_robots:
        features[:, :num_urllc, len(FEATURES) :] = _robot_features(simulator)
    return features


def _robot_features(simulator: Simulator) -> NDArray[np.float64]:
    """ROBOT_FEATURES of every robot, shape (E, R, 3); T_d as `simulator` forms it."""
    state, robots = simulator.state, simulator.constants.robots
    largest = robots.max_delay_steps
    position = state.robots.field(STATE, 2)
    num_robots = position.shape[1]
    delay_s = state.hol_delay_s[:, :num_robots] + robots.core_latency_s
    steps = np.ceil(delay_s / robots.sampling_s - 1e-9)
    return np.stack(
        (
            np.log1p(100.0 * np.hypot(position[..., 0], position[..., 1])),
            np.minimum(steps, largest) / largest,
            state.robots.gain_delay_steps / largest,
        ),
        axis=-1,
    )


def agent_views(
    features: NDArray[np.float32], num_urllc: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Give each agent its users' features, their slice's mean and the other slice's mean.

    Parameters
    ----------
    features
        Shape (..., U, F), URLLC users first.
    num_urllc
        How many of them are URLLC users.

    Returns
    -------
    urllc, embb
        Shapes (..., n, 3 F) with the users n of the slice.
    """
    slices = features[..., :num_urllc, :], features[..., num_urllc:, :]
    means = [part.mean(axis=-2, keepdims=True) for part in slices]
    own, other = slices, (means[1], means[0])
    urllc, embb = (
        np.concatenate(
            (
                own[k],
                np.broadcast_to(means[k], own[k].shape),
                np.broadcast_to(other[k], own[k].shape),
            ),
            axis=-1,
        )
        for k in range(2)
    )
    return urllc, embb
