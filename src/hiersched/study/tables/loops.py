"""Tables of the lower level: cells of the gain study, moments of the filter, growth over chains."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

from hiersched.control import Lqg, simulate_lqg
from hiersched.experiments.points import LOOP_CELLS, STUDY_PLANTS, experiments
from hiersched.scenario import Scenario, delay_steps
from hiersched.simulator.loop_growth import LoopGrowth, filter_growth, separates
from hiersched.study.growth import has_network_loop, loop_word
from hiersched.study.registry import table
from hiersched.study.statistics import mean_interval, paired_log_ratio
from hiersched.study.study import Study
from hiersched.study.tables.gains import by_run
from hiersched.study.tables.text import FORCED_LOOP_NOTE, RATIO_NOTE, SEEDS_NOTE, TROUBLE_NOTE

SIMULATED = 1200, 200
"""Samples and runs in which the linear robot is simulated; the first quarter is not measured."""


def has_loop_cells(scenario: Scenario) -> bool:
    """Whether the gain study has cells."""
    return LOOP_CELLS in experiments(scenario)


def filtered_cells(scenario: Scenario) -> dict[str, str]:
    """Return cells with a filter at a constant delay, of references alone: name, point.

    There the filter believes what is, but for how the reference turns. None where robots differ.
    """
    cells = scenario.gain_study.cells if has_loop_cells(scenario) else {}
    if scenario.robot_kinds or not separates(scenario):
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
    f"`over_first`: over the cell's first method. {RATIO_NOTE} {TROUBLE_NOTE} {FORCED_LOOP_NOTE}",
    reads=("windows", "growth"),
    when=has_loop_cells,
)
def cells_table(study: Study) -> pd.DataFrame:
    """Return the tracking error of every method in every cell, and of the nominal gain."""
    rows = []
    for name, runs in cell_runs(study).items():
        cell = study.scenario.gain_study.cells[name]
        errors = {method: own["error_cm"].to_numpy() for method, own in runs.items()}
        first_method, first = next(iter(errors.items()))
        for method, own in runs.items():
            is_nominal = method == "nominal"
            place = f"{name}_{first_method if is_nominal else method}"
            gain = "nominal" if is_nominal else "adjusted"
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
                    **study.loop_columns(LOOP_CELLS, place, gain, span="violated"),
                }
            )
    return pd.DataFrame(rows)


@table(
    "filter_moments",
    title="What the filter expects of the loop, and what came out",
    note="Root mean square position error. `expected_cm`: the stationary second moment of the "
    "linear model at a constant age, in closed form; `linear_cm`: that model simulated; "
    "`robots_cm`: the robots of the gain study, with saturation, turns and slots. "
    "`estimate_std_cm`: what the filter expects of its estimate's error. "
    f"{FORCED_LOOP_NOTE}",
    reads=("windows", "schedules", "growth"),
    when=has_filtered_cells,
)
def filter_table(study: Study) -> pd.DataFrame:
    """Compare the filter's moments with the linear model and the robots, age by age."""
    scenario, robots = study.scenario, study.robots(LOOP_CELLS)
    rows = []
    for name, value in filtered_cells(scenario).items():
        variant, lqg = _filter_at(study, LOOP_CELLS, value)
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
                **study.loop_columns(LOOP_CELLS, value, "adjusted", span="violated"),
            }
        )
    return pd.DataFrame(rows)


@table(
    "second_moments",
    title="Growth of the loops' second moments over the delays that the network gave",
    note="Factor a sample, of the user of each policy for whom the loop in force grows most "
    "without a hold, over the Markov chain of delays measured behind the warm-up, worlds together: "
    "below 1 the linear loop's second moment shrinks. `in_force`: the scenario's own method as it "
    "runs; `followed`: its gains, each delay's at once; `nominal`: the nominal gain; `filter`: the "
    "method lqg, whatever the delays. `beyond_share`: samples beyond the longest delay with a "
    "gain, where that gain acts on an older measurement still. A dash: delays too long to tell. "
    "`loop`: what the one in force does.",
    reads=("chains", "growth", "schedules"),
    when=has_network_loop,
)
def moments_table(study: Study) -> pd.DataFrame:
    """Return the growth of the second moment of each loop, under every policy at its worst user."""
    scenario, chains, growth = study.scenario, study.measures("chains"), study.measures("growth")
    chains = chains[chains["experiment"] == "evaluate"]
    filtered = _filter_growth(study)
    rows = []
    for row in growth[growth["experiment"] == "evaluate"].to_dict("records"):
        worst = chains[(chains["policy"] == row["policy"]) & (chains["robot"] == row["robot"])]
        steps, times = worst["delay_steps"], worst["count"]
        rows.append(
            {
                "policy": row["policy"],
                "user": int(row["robot"]),
                "mean_delay_steps": float((steps * times).sum() / times.sum()),
                "longest_delay_steps": int(steps.max()),
                "beyond_share": float(times[steps > scenario.max_delay_steps].sum() / times.sum()),
                **{name: row[name] for name in LoopGrowth._fields},
                "filter": filtered,
                "loop": loop_word(row["in_force"], scenario),
            }
        )
    return pd.DataFrame(rows)


def _filter_growth(study: Study) -> float:
    """Return that of the method lqg of the gain study; NaN without, or where robots differ."""
    scenario = study.scenario
    if scenario.robot_kinds:
        return math.nan
    if "lqg" not in scenario.gain_study.methods or STUDY_PLANTS["lqg"] != scenario.loop_kind:
        return math.nan
    return filter_growth(*_filter_at(study, "gain_study", "lqg"))


def _filter_at(study: Study, experiment: str, value: str) -> tuple[Scenario, Lqg]:
    """Return the scenario and the filter of a point of the gain study whose method is lqg."""
    variant = study.point(experiment, value).scenario
    lqg = study.schedule(variant).lqg
    assert lqg is not None  # such is the method
    return variant, lqg
