"""Regulator gains for loops with a delay, with certificates: see docs/control.md.

Importing this package loads NumPy and SciPy only; what solves matrix inequalities loads cvxpy when
it is first asked for.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from hiersched.control.certificate import (
    Certificate,
    DelayRazumikhinWitness,
    KrasovskiiWitness,
    RazumikhinWitness,
    certify,
)
from hiersched.control.delayed_plant import DelayedPlant, network_plant, split_plant
from hiersched.control.gain_schedule import build_schedule, load_or_build
from hiersched.control.gain_table import GainSchedule
from hiersched.control.h2 import h2_cost, h2_gain
from hiersched.control.hysteresis import hold_delays, hold_step
from hiersched.control.lifted import lift, simulate_random_delays, spectral_radius_by_delay
from hiersched.control.lqr import dlqr, latency_compensated, tracking_weights
from hiersched.control.predictor import input_memory_radii, predictor_gains

if TYPE_CHECKING:
    from hiersched.control.design import GainDesign, GainDesigner, design_gain
    from hiersched.control.krasovskii import analyse_krasovskii
    from hiersched.control.krasovskii_synthesis import KrasovskiiSynthesis, synthesise_krasovskii
    from hiersched.control.razumikhin import analyse_delay_razumikhin, analyse_razumikhin
    from hiersched.control.razumikhin_synthesis import RazumikhinSynthesis, synthesise_razumikhin
    from hiersched.control.switching import Switch, SwitchingReport, switching_report

__all__ = [
    "dlqr",
    "tracking_weights",
    "DelayedPlant",
    "network_plant",
    "split_plant",
    "lift",
    "spectral_radius_by_delay",
    "simulate_random_delays",
    "Certificate",
    "RazumikhinWitness",
    "DelayRazumikhinWitness",
    "KrasovskiiWitness",
    "certify",
    "analyse_razumikhin",
    "analyse_delay_razumikhin",
    "analyse_krasovskii",
    "synthesise_razumikhin",
    "RazumikhinSynthesis",
    "synthesise_krasovskii",
    "KrasovskiiSynthesis",
    "latency_compensated",
    "predictor_gains",
    "input_memory_radii",
    "h2_cost",
    "h2_gain",
    "GainDesign",
    "GainDesigner",
    "design_gain",
    "GainSchedule",
    "build_schedule",
    "load_or_build",
    "hold_step",
    "hold_delays",
    "Switch",
    "SwitchingReport",
    "switching_report",
]

_LAZY = {
    "GainDesign": "design",
    "GainDesigner": "design",
    "design_gain": "design",
    "analyse_krasovskii": "krasovskii",
    "KrasovskiiSynthesis": "krasovskii_synthesis",
    "synthesise_krasovskii": "krasovskii_synthesis",
    "analyse_delay_razumikhin": "razumikhin",
    "analyse_razumikhin": "razumikhin",
    "RazumikhinSynthesis": "razumikhin_synthesis",
    "synthesise_razumikhin": "razumikhin_synthesis",
    "Switch": "switching",
    "SwitchingReport": "switching",
    "switching_report": "switching",
}


def __getattr__(name: str) -> Any:
    """Load the names that need cvxpy on first use."""
    if name in _LAZY:
        try:
            return getattr(import_module(f"hiersched.control.{_LAZY[name]}"), name)
        except ModuleNotFoundError as error:
            error.add_note("pip install 'hiersched[control]'")
            raise
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
