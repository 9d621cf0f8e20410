"""Rewards of the agents, stored in parts: the multiplier of the constraint moves."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hiersched.policies.features import MULTIPLIER, multiplier_feature
from hiersched.scenario.schema import Scenario
from hiersched.simulator import SlotRecord


def user_rewards(
    one: SlotRecord,
    after: NDArray[np.float64],
    task_costs: NDArray[np.float64],
    scenario: Scenario,
) -> NDArray[np.float64]:
    """Share a slice's reward among its users: -(drift + V penalty) / scale, shape (E, U).

    Their mean over a slice's users is the reward in the record, leading axes (E, 1), up to the
    priced constraint and the `task_costs` (E, R), which each URLLC user pays for its own robot
    (`env.SlotLoop`). `after` is the backlog after the slot, shape (E, U), packets.
    """
    objective = scenario.objective
    drift = 0.5 * (after**2 - one.backlog_packets[:, 0] ** 2)
    penalty = 1.0 / (one.rate_mbps[:, 0] ** 2 + objective.epsilon)
    penalised = drift + objective.penalty_weight * penalty
    reward: NDArray[np.float64] = -penalised / scenario.learning.reward_scale
    reward[:, : scenario.users.num_urllc] -= task_costs
    return reward


def priced_rewards(
    base_reward: NDArray[np.float32],
    constraint: NDArray[np.float32],
    multipliers: NDArray[np.float64],
    reward_scale: float,
) -> Tensor:
    """Rewards of every user under the multipliers now in force, shape (seeds, B, U).

    `base_reward` is without the constraint, shape (seeds, B, U); `constraint` the y of each URLLC
    user, (seeds, B, R); the multipliers (seeds, R).
    """
    reward = base_reward.copy()
    priced = constraint * multipliers[:, None, :].astype(np.float32)
    reward[..., : multipliers.shape[1]] += priced / reward_scale
    return torch.from_numpy(reward)


def observe_multipliers(features: NDArray[np.float32], multipliers: NDArray[np.float64]) -> Tensor:
    """Put the multipliers now in force (seeds, R) among features (seeds, B, U, F), in place."""
    features[:, :, : multipliers.shape[1], MULTIPLIER] = multiplier_feature(multipliers)[:, None]
    return torch.from_numpy(features)
