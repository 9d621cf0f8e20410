"""Draws every figure of a results folder from its logs."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path

from matplotlib.figure import Figure

from hiersched.scenario import Scenario
from hiersched.study.collect import (
    cell_frame,
    checkpoint_frames,
    evaluation_frame,
    gain_frame,
    sweep_frame,
    training_frames,
)
from hiersched.study.comparison import bound_frame, bound_table, generalisation_table
from hiersched.study.distributions import delay_tails, rate_distributions
from hiersched.study.figures_comparison import (
    draw_bound,
    draw_delay,
    draw_generalise,
    draw_load,
    draw_pareto,
)
from hiersched.study.figures_delay import draw_violations
from hiersched.study.figures_gain import draw_gain
from hiersched.study.figures_gain_grid import draw_gain_grid
from hiersched.study.figures_gain_sweeps import (
    draw_gain_stability,
    draw_gain_sweeps,
    draw_gain_traces,
)
from hiersched.study.figures_learners import draw_learners, draw_learning
from hiersched.study.figures_rates import (
    draw_dexterity,
    draw_rate_cdf,
    draw_rayleigh,
    draw_sampling,
)
from hiersched.study.figures_training import draw_queues, draw_rewards
from hiersched.study.gain_logs import stability_frame, trace_frame
from hiersched.study.gain_summary import grid_table, sweeps_table
from hiersched.study.style import house_style, save_figure
from hiersched.study.summary import gain_table, policy_table, sweep_table


def draw_figures(results_dir: str | os.PathLike[str], scenario: Scenario) -> list[Path]:
    """Draw every figure from the logs of a results folder into ``figures/``, as SVG and PNG.

    Parameters
    ----------
    results_dir
        ``results/<scenario>`` with its logs.
    scenario
        The scenario that was run.

    Returns
    -------
    list of Path
        The files written.

    Raises
    ------
    FileNotFoundError
        If a log is missing.
    LogError
        If a log is damaged or contradicts itself.
    """
    results = Path(results_dir)
    folder = results / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    with house_style():
        for name, figure in build_figures(results, scenario).items():
            written += save_figure(figure(), folder, name)
    return written


def build_figures(results: Path, scenario: Scenario) -> Mapping[str, Callable[[], Figure]]:
    """Read the logs and return what draws each figure, by file name; call it in `house_style`."""
    learners = training_frames(results, scenario)
    fixed = checkpoint_frames(results, scenario)
    runs = evaluation_frame(results, scenario)
    policies = policy_table(runs, scenario)
    sweeps = sweep_table(sweep_frame(results, scenario), scenario)
    gains = gain_table(gain_frame(results, scenario))
    grid, gain_sweeps = grid_table(results, scenario), sweeps_table(results, scenario)
    traces, regions = trace_frame(results, scenario), stability_frame(results)
    bound = bound_table(bound_frame(results))
    elsewhere = generalisation_table(cell_frame(results, scenario), scenario)
    rates, tails = rate_distributions(results, scenario), delay_tails(results, scenario)
    return {
        "fig2_rewards": lambda: draw_rewards(learners, fixed, scenario),
        "fig3_queues": lambda: draw_queues(learners, fixed, scenario),
        "fig4_rate_cdf": lambda: draw_rate_cdf(rates, scenario),
        "fig5_rayleigh": lambda: draw_rayleigh(sweeps, scenario),
        "fig6_sampling": lambda: draw_sampling(sweeps, scenario),
        "fig7_dexterity": lambda: draw_dexterity(sweeps, scenario),
        "fig8_violations": lambda: draw_violations(policies, runs, tails, scenario),
        "figX_learning": lambda: draw_learning(learners, fixed, scenario),
        "figX_learners": lambda: draw_learners(sweeps, scenario),
        "figX_load": lambda: draw_load(sweeps, scenario),
        "figX_delay": lambda: draw_delay(tails, scenario),
        "figX_pareto": lambda: draw_pareto(policies, scenario),
        "figX_bound": lambda: draw_bound(bound, scenario),
        "figX_generalise": lambda: draw_generalise(elsewhere, scenario),
        "figX_gain": lambda: draw_gain(gains, scenario),
        "figX_gain_grid": lambda: draw_gain_grid(grid, scenario),
        "figX_gain_sweeps": lambda: draw_gain_sweeps(gain_sweeps, scenario),
        "figX_gain_traces": lambda: draw_gain_traces(traces, scenario),
        "figX_gain_stability": lambda: draw_gain_stability(regions, scenario),
    }
