"""Who gets which resource block, and the objective of a slot."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hiersched.core.compiled import inner_kernel
from hiersched.core.seam import Seam

ALLOCATE = Seam(
    "allocation of a rule",
    reads="as the index of a rule; state.index_weight[env], state.need_mbps[env] (U,) of that; "
    "state.weight[env], state.drift_weight[env] (U,)",
    writes="slot.prb_owner (K,): every user must get a PRB or more",
)


@inner_kernel()
def check_weights(weight: NDArray[np.float64], least: float) -> None:
    """Refuse weights (U,) below the least, and what is not finite."""
    wrong = 0
    for user in range(weight.shape[0]):
        if not (least <= weight[user] < np.inf):
            wrong += 1
    if wrong > 0:
        raise ValueError("a policy gave a user a weight that is negative or not finite")


@inner_kernel()
def check_needs(need: NDArray[np.float64]) -> None:
    """Refuse needs (U,) that are negative or not there."""
    wrong = 0
    for user in range(need.shape[0]):
        if not need[user] >= 0.0:
            wrong += 1
    if wrong > 0:
        raise ValueError("a rule gave a user a need that is negative or not a number, or none")
