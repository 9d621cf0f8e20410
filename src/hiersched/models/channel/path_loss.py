"""What distance and obstacles take of the power."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from hiersched.core.numerics import sincos
from hiersched.core.parameters import NonNegative, Note, Positive
from hiersched.core.randomness import STREAM_POSITION, draw_uniforms
from hiersched.models.model import PATH_LOSS, PathLoss

if TYPE_CHECKING:
    from hiersched.scenario.schema import Scenario


@PATH_LOSS.model
@dataclass(frozen=True, kw_only=True)
class NoPathLoss(PathLoss):
    """No loss: users differ by fading alone."""

    model: Annotated[
        Literal["none"],
        Note("model", "paper", "none | macro (128.1 + 37.6 log10(d/km) dB with shadowing)"),
    ] = "none"

    def gain(self, key: int, num_users: int) -> NDArray[np.float64]:
        """Return gains of 1, shape (num_users,)."""
        return np.ones(num_users)


@PATH_LOSS.model
@dataclass(frozen=True, kw_only=True)
class Macro(PathLoss):
    """Macro cell at 2 GHz (3GPP TR 36.942): users uniform over a disc, log-normal shadowing."""

    model: Annotated[
        Literal["macro"], Note("model", "paper", "128.1 + 37.6 log10(d/km) dB with shadowing")
    ] = "macro"
    cell_radius_m: Annotated[Positive, Note("m", "paper", "users lie within it")] = 400.0
    min_distance_m: Annotated[Positive, Note("m", "assumed", "users lie beyond it")] = 35.0
    shadowing_db: Annotated[
        NonNegative, Note("dB", "assumed", "standard deviation of the log-normal shadowing")
    ] = 8.0

    def gain(self, key: int, num_users: int) -> NDArray[np.float64]:
        """As in `PathLoss`; places belong to the world, so every policy meets the same users."""
        uniforms = np.empty((3, num_users))
        for lane in range(3):
            draw_uniforms(np.uint64(key), STREAM_POSITION, 0, lane, uniforms[lane])
        nearest, farthest = self.min_distance_m**2, self.cell_radius_m**2
        distance_m = np.sqrt(nearest + uniforms[0] * (farthest - nearest))
        # Logarithms one by one: NumPy's differ in their last bits from one processor to another.
        ln_uniform = np.array([math.log(value) for value in uniforms[1]])
        log_distance = np.array([math.log10(value / 1000.0) for value in distance_m])
        normal = np.sqrt(-2.0 * ln_uniform) * sincos(2.0 * np.pi * uniforms[2])[1]
        loss_db = 128.1 + 37.6 * log_distance + self.shadowing_db * normal
        return np.array([math.pow(10.0, -loss / 10.0) for loss in loss_db])

    def least_gain_db(self) -> float:
        """Return that at the edge: normal draws from doubles stay within nine deviations."""
        edge_loss_db = 128.1 + 37.6 * math.log10(self.cell_radius_m / 1000.0)
        return -(edge_loss_db + 9.0 * self.shadowing_db)

    def faults(self, scenario: Scenario) -> list[str]:
        """Say where no user could lie."""
        if self.min_distance_m < self.cell_radius_m:
            return []
        return [
            f"radio.path_loss.min_distance_m = {self.min_distance_m}: must be below "
            f"radio.path_loss.cell_radius_m = {self.cell_radius_m}"
        ]
