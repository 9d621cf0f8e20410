"""Regulator gains for loops with a delay, with certificates: see docs/control.md.

Unless a docstring says otherwise, a plant has n states and m inputs: A, A_c, A_d, P, Q, S and X
have shape (n, n), B (n, m), a gain K (m, n), and R (m, m) as the weight of the input, (n, n) in a
functional. Delays are in samples, `delay_steps` is the longest one, T. An argument that is
malformed (its shape, an entry that is not finite, a matrix that is not symmetric or definite, a
delay that is negative or not whole) is a ValueError that names it.

Importing this package loads NumPy and SciPy only; what solves matrix inequalities loads cvxpy when
it is first asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hiersched.control.certificate import (
    Certificate,
    DelayRazumikhinWitness,
    IntervalWitness,
    KrasovskiiWitness,
    RazumikhinWitness,
    certify,
)
from hiersched.control.delayed_plant import DelayedPlant, network_plant, split_plant
from hiersched.control.gain_schedule import GainSchedule, build_schedule, load_or_build
from hiersched.control.h2 import h2_cost, h2_gain
from hiersched.control.hysteresis import hold_delays, hold_step
from hiersched.control.interval import analyse_interval, certify_interval
from hiersched.control.lifted import lift, simulate_random_delays, spectral_radius_by_delay
from hiersched.control.lqg import FilterModel, Lqg, design_lqg, simulate_lqg, stationary_filter
from hiersched.control.lqr import dlqr, latency_compensated, tracking_weights
from hiersched.control.predictor import input_memory_radii, predictor_gains
from hiersched.core.extras import lazy_names

if TYPE_CHECKING:
    from hiersched.control.design import GainDesign, GainDesigner, design_gain
    from hiersched.control.krasovskii import KrasovskiiSynthesis, analyse_krasovskii
    from hiersched.control.razumikhin import (
        RazumikhinSynthesis,
        analyse_delay_razumikhin,
        analyse_razumikhin,
    )
    from hiersched.control.second_moments import (
        Chain,
        chain_of_counts,
        count_transitions,
        second_moment_growth,
        simulate_chain,
    )
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
    "IntervalWitness",
    "certify",
    "analyse_interval",
    "certify_interval",
    "analyse_razumikhin",
    "analyse_delay_razumikhin",
    "analyse_krasovskii",
    "RazumikhinSynthesis",
    "KrasovskiiSynthesis",
    "latency_compensated",
    "predictor_gains",
    "input_memory_radii",
    "h2_cost",
    "h2_gain",
    "FilterModel",
    "Lqg",
    "design_lqg",
    "stationary_filter",
    "simulate_lqg",
    "GainDesign",
    "GainDesigner",
    "design_gain",
    "GainSchedule",
    "build_schedule",
    "load_or_build",
    "Chain",
    "chain_of_counts",
    "count_transitions",
    "second_moment_growth",
    "simulate_chain",
    "hold_step",
    "hold_delays",
    "Switch",
    "SwitchingReport",
    "switching_report",
]

__getattr__ = lazy_names(
    __name__,
    {
        "GainDesign": "design",
        "GainDesigner": "design",
        "design_gain": "design",
        "KrasovskiiSynthesis": "krasovskii",
        "analyse_krasovskii": "krasovskii",
        "RazumikhinSynthesis": "razumikhin",
        "analyse_delay_razumikhin": "razumikhin",
        "analyse_razumikhin": "razumikhin",
        "Chain": "second_moments",
        "chain_of_counts": "second_moments",
        "count_transitions": "second_moments",
        "second_moment_growth": "second_moments",
        "simulate_chain": "second_moments",
        "Switch": "switching",
        "SwitchingReport": "switching",
        "switching_report": "switching",
    },
)
