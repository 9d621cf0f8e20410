"""What distance and obstacles take: nothing, or a macro cell's path loss and shadowing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hiersched.models.channel.link_budget import large_scale_gain
from hiersched.models.model import PathLoss


class NoPathLoss(PathLoss):
    """All users are as near."""

    def gain(self, key: int, num_users: int) -> NDArray[np.float64]:
        """As in `PathLoss`."""
        return np.ones(num_users)


class Macro(PathLoss):
    """Users placed uniformly over a disc: 128.1 + 37.6 log10(d / 1 km) dB, log-normal shadowing."""

    cell_radius_m: float
    min_distance_m: float
    shadowing_db: float

    def gain(self, key: int, num_users: int) -> NDArray[np.float64]:
        """As in `PathLoss`."""
        return large_scale_gain(
            key,
            num_users,
            cell_radius_m=self.cell_radius_m,
            min_distance_m=self.min_distance_m,
            shadowing_db=self.shadowing_db,
        )
