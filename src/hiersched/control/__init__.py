"""Regulator gains that are certified for a given network delay.

Importing this package loads NumPy and SciPy only; `design_gain`, `GainDesign` and `GainDesigner`
load cvxpy when they are first asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hiersched.control.certificate import (
    Certificate,
    certify,
    lift,
    spectral_radius_by_delay,
)
from hiersched.control.lqr import dlqr, latency_compensated, tracking_weights
from hiersched.control.plant import DelayedPlant, network_plant, split_plant
from hiersched.control.schedule import GainSchedule, build_schedule, load_or_build

if TYPE_CHECKING:
    from hiersched.control.design import GainDesign, GainDesigner, design_gain

__all__ = [
    "dlqr",
    "tracking_weights",
    "latency_compensated",
    "DelayedPlant",
    "network_plant",
    "split_plant",
    "Certificate",
    "certify",
    "lift",
    "spectral_radius_by_delay",
    "GainDesign",
    "GainDesigner",
    "design_gain",
    "GainSchedule",
    "build_schedule",
    "load_or_build",
]

_LAZY = ("GainDesign", "GainDesigner", "design_gain")


def __getattr__(name: str) -> Any:
    """Load the names that need cvxpy on first use."""
    if name in _LAZY:
        from hiersched.control import design

        return getattr(design, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
