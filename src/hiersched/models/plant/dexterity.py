"""The dexterity index of a window: 0.4 tracking, 0.3 orientation, 0.3 curvature."""

from __future__ import annotations

import math

from hiersched.core.compiled import kernel

MIN_SPEED_MPS = 0.05
"""Speed below which the curvature is taken at this speed: |omega| / max(|v|, MIN_SPEED_MPS)."""


@kernel()
def dexterity_index(
    tracking_error_cm: float, orientation_error_deg: float, curvature_per_m: float
) -> float:
    """Dexterity index in [0, 1] of one window.

    Of the root mean square of the position error, the mean size of the heading error, and the mean
    of |omega| / max(|v|, 0.05 m/s).
    """
    return (
        0.4 * max(0.0, 1.0 - tracking_error_cm / 10.0)
        + 0.3 * max(0.0, 1.0 - orientation_error_deg / 180.0)
        + 0.3 * max(0.0, 1.0 - curvature_per_m)
    )


@kernel()
def window_index(
    square_error_m2: float, heading_error_rad: float, curvature_per_m: float, count: int
) -> float:
    """Dexterity index from sums over `count` integration steps."""
    return dexterity_index(
        100.0 * math.sqrt(square_error_m2 / count),
        heading_error_rad / count * (180.0 / math.pi),
        curvature_per_m / count,
    )
