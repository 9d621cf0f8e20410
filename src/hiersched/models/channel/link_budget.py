"""From transmit power to the rate of every resource block: r = B log2(1 + p g |h|^2 / noise)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hiersched.core.compiled import kernel
from hiersched.core.numerics import log2_f64
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


@kernel()
def prb_rates(
    fading_power: NDArray[np.float32],
    snr: NDArray[np.float64],
    prb_bandwidth_mhz: float,
    rate_mbps: NDArray[np.float32],
) -> None:
    """Rate of every user on every PRB, in place: B log2(1 + snr |h|^2).

    Parameters
    ----------
    fading_power
        Squared fading amplitude, shape (U*K,), user by user.
    snr
        Signal-to-noise ratio at unit fading power, shape (U*K,), linear: each user's value K times.
    prb_bandwidth_mhz
        Bandwidth of one PRB.
    rate_mbps
        Result, shape (U*K,). Rounded to float32, so that sums over PRBs in double are exact and do
        not depend on their order: a reader of the log gets the same bits.
    """
    for i in range(fading_power.shape[0]):
        snr_i = snr[i] * np.float64(fading_power[i])
        rate_mbps[i] = np.float32(prb_bandwidth_mhz * log2_f64(1.0 + snr_i))
