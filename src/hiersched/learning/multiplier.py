"""The multiplier of the delay constraint: one proportional-integral step an episode."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hiersched.scenario.schema import Objective


@dataclass(frozen=True)
class Multiplier:
    """Multipliers of the URLLC users; `integral` has any shape (..., R)."""

    integral: NDArray[np.float64]
    value: NDArray[np.float64]

    @classmethod
    def zero(cls, shape: tuple[int, ...]) -> Multiplier:
        """All multipliers 0."""
        return cls(integral=np.zeros(shape), value=np.zeros(shape))


def step_multiplier(
    multiplier: Multiplier, constraint: NDArray[np.float64], objective: Objective
) -> Multiplier:
    """Dual step: I <- clip(I - eta y, 0, max), lambda = clip(I - kappa y, 0, max).

    y is the mean constraint of the last episodes, negative where it was violated, shape (..., R).
    The integral stays within the range of the multiplier, so that it does not wind up at the cap;
    the proportional part damps the oscillation of plain ascent (Stooke et al., ICML 2020).
    """
    cap = objective.multiplier_max
    integral = np.clip(multiplier.integral - objective.multiplier_step * constraint, 0.0, cap)
    value = np.clip(integral - objective.multiplier_proportional * constraint, 0.0, cap)
    return Multiplier(integral=integral, value=value)


def episode_constraint(
    objective: Objective,
    reliability: float,
    due_packets: NDArray[np.float64],
    late_packets: NDArray[np.float64],
    mean_constraint: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Mean y of a round of episodes, shape (..., R) as the sums of packets.

    `objective.constraint` decides: ``measured`` gives (1 - chi) - late share of each user, chi the
    reliability, ``surrogate`` the mean over all users of the paper's y, the same for each
    (`mean_constraint` has the mean of the slots' y).
    """
    if objective.constraint == "measured":
        share = np.divide(
            late_packets, due_packets, out=np.zeros_like(late_packets), where=due_packets > 0
        )
        return (1.0 - reliability) - share
    mean = mean_constraint.mean(axis=-1, keepdims=True)
    return np.broadcast_to(mean, mean_constraint.shape).copy()
