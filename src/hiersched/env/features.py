"""What each agent of the parallel environment sees: its users' features and the slices' means."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


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
