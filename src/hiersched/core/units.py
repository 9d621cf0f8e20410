"""Conversions between logarithmic and linear units."""

from __future__ import annotations

import math


def db_to_linear(value_db: float) -> float:
    """Power ratio of a value in dB."""
    return math.pow(10.0, value_db / 10.0)


def linear_to_db(ratio: float) -> float:
    """Value in dB of a positive power ratio.

    Raises
    ------
    ValueError
        If the ratio is not positive.
    """
    if not ratio > 0:
        raise ValueError(f"a power ratio must be positive to have a value in dB, got {ratio!r}")
    return 10.0 * math.log10(ratio)


def dbm_to_w(power_dbm: float) -> float:
    """Power in W of a level in dBm."""
    return 1e-3 * db_to_linear(power_dbm)


def w_to_dbm(power_w: float) -> float:
    """Level in dBm of a positive power in W."""
    return linear_to_db(power_w / 1e-3)
