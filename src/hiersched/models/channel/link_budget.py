"""From transmit power to the signal-to-noise ratio of every user: p g / noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hiersched.core.randomness import STREAM_POSITION, draw_uniforms
from hiersched.core.units import db_to_linear, dbm_to_w


def snr_per_fading_power(tx_power_dbm: float, noise_dbm: float) -> float:
    """Signal-to-noise ratio of one PRB at unit fading power and unit large-scale gain (linear)."""
    return dbm_to_w(tx_power_dbm) / dbm_to_w(noise_dbm)


def large_scale_gain(
    key: int,
    num_users: int,
    *,
    cell_radius_m: float,
    min_distance_m: float,
    shadowing_db: float,
) -> NDArray[np.float64]:
    """Large-scale gains of users placed uniformly over a disc, shape (num_users,), linear.

    Path loss 128.1 + 37.6 log10(d / 1 km) dB (3GPP TR 36.942, macro cell at 2 GHz) plus log-normal
    shadowing. The place belongs to the world `key`, so every policy meets the same users.
    """
    uniforms = np.empty((3, num_users))
    for lane in range(3):
        draw_uniforms(np.uint64(key), STREAM_POSITION, 0, lane, uniforms[lane])
    distance_m = np.sqrt(min_distance_m**2 + uniforms[0] * (cell_radius_m**2 - min_distance_m**2))
    normal = np.sqrt(-2.0 * np.log(uniforms[1])) * np.cos(2.0 * np.pi * uniforms[2])
    loss_db = 128.1 + 37.6 * np.log10(distance_m / 1000.0) + shadowing_db * normal
    return np.array([db_to_linear(-loss) for loss in loss_db])
