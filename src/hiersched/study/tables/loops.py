"""Tables of the lower level: cells of the gain study, moments of the filter, growth over chains."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

from hiersched.control import simulate_lqg
from hiersched.experiments.points import LOOP_CELLS, STUDY_PLANTS, experiments
from hiersched.scenario import Scenario, delay_steps
from hiersched.simulator.loop_growth import filter_growth, separates, worst_growth
from hiersched.study.growth import has_network_loop, robot_counts
from hiersched.study.registry import table
from hiersched.study.statistics import mean_interval, paired_log_ratio
from hiersched.study.study import Study
from hiersched.study.tables.gains import by_run
from hiersched.study.tables.text import RATIO_NOTE, SEEDS_NOTE, TROUBLE_NOTE

SIMULATED = 1200, 200
"""Samples and runs in which the linear robot is simulated; the first quarter is not measured."""


def has_loop_cells(scenario: Scenario) -> bool:
    """Whether the gain study has cells."""
    return LOOP_CELLS in experiments(scenario)


def filtered_cells(scenario: Scenario) -> dict[str, str]:
    """Return cells with a filter at a constant delay, of references alone: name, point.

    There the filter believes what is, but for how the reference turns.
    """
    cells = scenario.gain_study.cells if has_loop_cells(scenario) else {}
    if not separates(scenario):
        return {}
    return {
        name: f"{name}_lqg"
        for name, cell in cells.items()
        if all(key.startswith("robot.reference") for key in cell.values)
        and not cell.sawtooth
        and "lqg" in (cell.methods or scenario.gain_study.cell_methods)
    }


def has_filtered_cells(scenario: Scenario) -> bool:
    """Whether there is a cell of `filtered_cells`."""
    return bool(filtered_cells(scenario))


def cell_runs(study: Study) -> dict[str, dict[str, pd.DataFrame]]:
    """Return a row a run (`tables.gains.by_run`) of every cell and method, ``nominal`` among them.

    The first window, in which robots leave their rest, does not count.
    """
    robots, scenario = study.robots(LOOP_CELLS), study.scenario
    robots = robots[robots["window"] > 1]
    found: dict[str, dict[str, pd.DataFrame]] = {}
    for name, cell in scenario.gain_study.cells.items():
        methods: tuple[str, ...] = cell.methods or scenario.gain_study.cell_methods
        own = {method: robots[robots["value"] == f"{name}_{method}"] for method in methods}
        runs = {m: by_run(rows[rows["gain"] == "adjusted"]) for m, rows in own.items()}
        first = own[methods[0]]
        runs["nominal"] = by_run(first[first["gain"] == "nominal"])
        found[name] = runs
    return found


@table(
    "gain_cells",
    title="Gain study: methods at constant and growing delays, and where beliefs are wrong",
    note=f"{SEEDS_NOTE} Root mean square over a window, mean over windows and robots. "
    f"`over_first`: over the cell's first method. {RATIO_NOTE} {TROUBLE_NOTE}",
    reads=("windows",),
    when=has_loop_cells,
)
def cells_table(study: Study) -> pd.DataFrame:
    """Return the tracking error of every method in every cell, and of the nominal gain."""
    rows = []
    for name, runs in cell_runs(study).items():
        cell = study.scenario.gain_study.cells[name]
        errors = {method: own["error_cm"].to_numpy() for method, own in runs.items()}
        first = next(iter(errors.values()))
        for method, own in runs.items():
            ratio = paired_log_ratio(errors[method], first).columns("over_first")
            rows.append(
                {
                    "cell": name,
                    "delay_s": cell.delay_s,
                    "sawtooth": cell.sawtooth,
                    "method": method,
                    **mean_interval(errors[method]).columns("error_cm"),
                    **ratio,
                    "off_track_share": float(own["off_track"].mean()),
                    "saturated_share": float(own["saturated"].mean()),
                    "seeds": len(own),
                }
            )
    return pd.DataFrame(rows)


@table(
    "filter_moments",
    title="What the filter expects of the loop, and what came out",
    note="Root mean square position error. `expected_cm`: the stationary second moment of the "
    "linear model at a constant age, in closed form; `linear_cm`: that model simulated; "
    "`robots_cm`: the robots of the gain study, with saturation, turns and slots. "
    "`estimate_std_cm`: what the filter expects of its estimate's error.",
    reads=("windows", "schedules"),
    when=has_filtered_cells,
)
def filter_table(study: Study) -> pd.DataFrame:
    """Compare the filter's moments with the linear model and the robots, age by age."""
    scenario, robots = study.scenario, study.robots(LOOP_CELLS)
    rows = []
    for name, value in filtered_cells(scenario).items():
        variant = study.point(LOOP_CELLS, value).scenario
        lqg = study.schedule(variant).lqg
        assert lqg is not None  # such is the method
        age = delay_steps(scenario.gain_study.cells[name].delay_s, variant.control.sampling_s)
        places = list(variant.plant.position_states())
        states, _ = simulate_lqg(lqg, np.full(SIMULATED, age))
        settled = states[SIMULATED[0] // 4 :, :, places]
        linear_m = math.sqrt((settled**2).sum(axis=2).mean())
        expected_m = math.sqrt(np.diag(lqg.second_moment(age))[places].sum())
        own = robots[(robots["value"] == value) & (robots["gain"] == "adjusted")]
        error_cm = own[own["window"] > 1]["error_cm"].to_numpy()
        robots_cm = math.sqrt((error_cm**2).mean())
        rows.append(
            {
                "cell": name,
                "age_samples": age,
                "delay_s": age * variant.control.sampling_s,
                "expected_cm": 100.0 * expected_m,
                "linear_cm": 100.0 * linear_m,
                "linear_over_expected": linear_m / expected_m,
                "robots_cm": robots_cm,
                "robots_over_expected": robots_cm / (100.0 * expected_m),
                "estimate_std_cm": 100.0
                * math.sqrt(np.diag(lqg.prediction_covariance(age))[places].sum()),
            }
        )
    return pd.DataFrame(rows)


@table(
    "second_moments",
    title="Growth of the loops' second moments over the delays that the network gave",
    note="Factor a sample, of the user of each policy for whom `followed` is greatest, over the "
    "Markov chain of delays measured behind the warm-up, worlds together: below 1 the linear "
    "loop's second moment shrinks. `in_force`: the scenario's own method as it runs; `followed`: "
    "its gains, each delay's at once; `nominal`: the nominal gain; `filter`: the method lqg, "
    "whatever the delays. `beyond_share`: samples beyond the longest delay with a gain, where that "
    "gain acts on an older measurement still. A dash: delays too long to tell. `grows`: the loop "
    "in force grows.",
    reads=("chains", "schedules"),
    when=has_network_loop,
)
def moments_table(study: Study) -> pd.DataFrame:
    """Return the growth of the second moment of each loop, under every policy at its worst user."""
    scenario = study.scenario
    schedule, chains = study.schedule(scenario), study.measures("chains")
    filtered = _filter_growth(study)
    rows = []
    for policy, own in chains.groupby("policy", sort=False):
        user, growth = worst_growth(scenario, schedule, robot_counts(own))
        worst = own[own["robot"] == user]
        steps, times = worst["delay_steps"], worst["count"]
        rows.append(
            {
                "policy": policy,
                "user": user,
                "mean_delay_steps": float((steps * times).sum() / times.sum()),
                "longest_delay_steps": int(steps.max()),
                "beyond_share": float(times[steps > scenario.max_delay_steps].sum() / times.sum()),
                **growth._asdict(),
                "filter": filtered,
                "grows": None if math.isnan(growth.in_force) else growth.in_force >= 1.0,
            }
        )
    return pd.DataFrame(rows)


def _filter_growth(study: Study) -> float:
    """Return that of the method lqg of the gain study, NaN without."""
    scenario = study.scenario
    if "lqg" not in scenario.gain_study.methods or STUDY_PLANTS["lqg"] != scenario.loop_kind:
        return math.nan
    variant = study.point("gain_study", "lqg").scenario
    lqg = study.schedule(variant).lqg
    return math.nan if lqg is None else filter_growth(variant, lqg)
