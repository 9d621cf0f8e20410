"""Writes the tables of a results folder, as CSV with full precision and as Markdown to read."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import pandas as pd

from hiersched.core.files import csv_text, write_bytes
from hiersched.scenario import Scenario, load_scenario, scenario_notes, scenario_to_dict
from hiersched.scenario.plugins import CONFIG
from hiersched.study.collect import (
    cell_frame,
    evaluation_frame,
    gain_frame,
    gain_schedules,
    sweep_frame,
)
from hiersched.study.comparison import (
    bound_frame,
    bound_table,
    generalisation_table,
    score_table,
)
from hiersched.study.gain_summary import (
    grid_table,
    methods_table,
    stability_table,
    sweeps_table,
)
from hiersched.study.intervals import INTERVAL_NOTE
from hiersched.study.learners import differing_keys, learner_table
from hiersched.study.paper import SYMBOLS
from hiersched.study.summary import (
    comparison_table,
    gain_table,
    policy_table,
    rate_table,
    schedule_table,
    sweep_table,
)

_SEEDS = "Means over seeds, in brackets their Student t 95 % intervals."
_LOGGED = (
    "The learned policy's slots are those of its logs: world i ran the policy of training seed i."
)
_MEDIAN = "`…_median`: over worlds, of learned policies over policies and worlds."
_LEARNED = (
    "Learned policies: every trained policy in every world, ratios and differences by world within "
    "each; intervals have the parts of both."
)
_RATIO = (
    "Ratios are geometric means over the same worlds, in brackets Student's 95 % interval of their "
    "logarithms."
)
_NONE = (
    "A share of 0 in a world enters a ratio as the least share that could be seen there. Where "
    "those of a policy do, ratio and upper bound are upper bounds, and the lower bound is 0; where "
    "those of the baseline do, ratio and lower bound are lower bounds, and there is no upper one; "
    "a dash: both do."
)
_TROUBLE = (
    "Shares of robots: `off_track`, over 10 cm in a window; `saturated`, at a control limit for "
    "half of one. All robots are in the means."
)
TITLES = {
    "table1_parameters": (
        "Table I: parameters",
        "`paper`: the value stands in the paper; `assumed`: it does not, or this scenario departs "
        "from it.",
    ),
    "table2_gain": (
        "Table II: tracking error in the windows of violated delay",
        f"{_SEEDS} Root mean square over a window, mean over robots; slot 1 is the first window. "
        f"{_RATIO} The paper gives no unit: only its ratio compares.",
    ),
    "table2_methods": (
        "Tracking error in every window of the gain study, by method",
        f"{_SEEDS} {_RATIO}",
    ),
    "table3_rate": (
        "Table III: mean data rate of the URLLC users",
        f"{_SEEDS} Slot 1 is the first slot of a run; `mean` is over the whole run. The channel "
        "gain is the mean of |h|² over URLLC users and PRBs, 2 s² in expectation; the paper does "
        f"not define its own. {_RATIO} {_LOGGED}",
    ),
    "policies": (
        "Policies in the same worlds",
        f"{INTERVAL_NOTE} {_MEDIAN} `urllc_late_share_smallest`: the least late share that these "
        "worlds tell from 0. `mean_square_backlog`: time average of ½ΣF² [packets²]. Delays are of "
        "delivered packets; packets that still wait count in the late shares alone. "
        "`backlog_over_best`, `improvement`: mean square backlog over that of the best classical "
        "scheduler, and the probability that it is less in another world. The CSV has more "
        f"columns. {_LEARNED}",
    ),
    "comparison": (
        "Policies against PF, and against the best classical scheduler, in the same worlds",
        f"{_RATIO} {_NONE} Differences with Student t 95 % intervals. {_LEARNED}",
    ),
    "sweeps": (
        "Sweeps: one axis varied at a time",
        f"{INTERVAL_NOTE} The CSV has more columns.",
    ),
    "gain_methods": (
        "Gain study: every method against the nominal gain, in the same worlds",
        f"{_SEEDS} {_RATIO} `violated` and `calm`: all such slots. `delay_steps`, `status`, "
        "`certified`: the delays there, the gains in force at them and how many of these are "
        "certified; gains follow the delay, so a method may also differ from the nominal gain in "
        f"calm slots. {_TROUBLE}",
    ),
    "gain_grid": (
        "Gain study: weight q against a constant delay in the violated window",
        f"{_SEEDS} {_RATIO} `effect`: helps or hurts where that interval excludes 1, `same gain` "
        f"where the nominal gain stays in force. {_TROUBLE}",
    ),
    "gain_sweeps": (
        "Gain study: sampling interval and measurement noise",
        f"{_SEEDS} {_RATIO} The first unstable constant delay is of the nominal gain, by the "
        "spectral radius of the lifted system; a dash: none up to the longest delay with a gain. "
        f"{_TROUBLE}",
    ),
    "gain_stability": (
        "Gain study: longest delays",
        "Up to `delay_steps` samples: `exact`, the spectral radius of the lifted system is below 1 "
        "at each constant delay; `c1`, `c2`, `c3`, every sequence of such delays is certified, all "
        "for the nominal gain; `adjusted`, exact, for the gain made for the longest delay of the "
        "grid. `at_least`: no longer delay was tried; a dash: not even without delay.",
    ),
    "learners": (
        "Learners along the load, against the scenario's own",
        f"{INTERVAL_NOTE} `differs`: keys of the section `learning` that are not the scenario's. "
        "Columns `…_minus_own`, `…_over_own`: paired differences from the scenario's own learner, "
        f"and typical ratios, the k-th training seeds of both in the same world. {_NONE}",
    ),
    "scores": (
        "Policies over all loads",
        "Score: log(PF / own) / log(PF / best classical scheduler of the load) of mean square "
        "backlogs, both summed over the loads; 0 is PF, 1 the best. Mean and Student t 95 % "
        f"interval over worlds. {_LEARNED} `shorter_worlds`: share of worlds and loads in which "
        "the policy's mean square backlog is below that of the best classical scheduler.",
    ),
    "generalisation": (
        "Trained policies where they were not trained",
        f"{INTERVAL_NOTE} Cells: URLLC users, eMBB users, PRBs. `backlog_over_best`: mean square "
        "backlog over that of the best classical scheduler there, world by world. Sweeps: other "
        "loads and scales.",
    ),
    "bound": (
        "Distance from the exact optimum of a slot",
        "`gap`: drift-plus-penalty Lagrangian of the decision minus that of the exact optimum in "
        "the same state, mean and Student t 95 % interval over worlds, world i under the learned "
        "policy of training seed i. `uncertified`: what the "
        "solver's bound leaves open. `first_gap`: sum from giving everyone the first PRB greedily "
        "minus exactly; `first_log_rate_gap`: the same for minus the logarithm of the rates.",
    ),
    "gains": (
        "Gain schedule",
        "Deviation is the Frobenius norm of adjusted minus nominal gain; spectral radii are the "
        "largest over all constant delays up to T, of the gain in force and of the nominal one.",
    ),
}

_READ_MEASURES = (
    "urllc_late_share",
    "embb_late_share",
    "urllc_rate_mbps",
    "embb_rate_mbps",
    "urllc_backlog_packets",
    "embb_backlog_packets",
    "urllc_delay_p99_s",
    "tracking_error_cm",
    "dexterity_index",
    "mean_square_backlog",
    "penalty_cost",
)
_MEDIANS = ("urllc_late_share", "embb_late_share", "mean_square_backlog")
_READ_INTERVALS = [f"{name}{end}" for name in _READ_MEASURES for end in ("", "_lo", "_hi")]
READ_COLUMNS = {
    "policies": [
        *["policy", "seeds", "training_seeds", *_READ_INTERVALS],
        *[f"{name}_median" for name in _MEDIANS],
        "urllc_late_share_smallest",
        *[
            f"{name}{end}"
            for name in ("backlog_over_best", "improvement")
            for end in ("", "_lo", "_hi")
        ],
        "best_classical",
    ],
    "sweeps": ["axis", "value", "policy", *_READ_INTERVALS],
}
"""Columns of the Markdown of wide tables; the CSV has all."""


def write_tables(
    results_dir: str | os.PathLike[str], scenario: Scenario, *, defaults: Path | None = None
) -> list[Path]:
    """Compute every table from the logs of a results folder and write it to ``tables/``.

    Parameters
    ----------
    results_dir
        ``results/<scenario>`` with its logs.
    scenario
        The scenario that was run.
    defaults
        File with every parameter's meaning, for Table I; that of the package unless given.

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
    folder = results / "tables"
    folder.mkdir(parents=True, exist_ok=True)
    evaluation, sweeps = evaluation_frame(results, scenario), sweep_frame(results, scenario)
    cells = cell_frame(results, scenario)
    elsewhere = pd.concat([cells, sweeps], ignore_index=True)
    gains = gain_table(gain_frame(results, scenario))
    first = gains["method"] == gains["method"].iloc[0]
    tables = {
        "table1_parameters": parameter_table(scenario, defaults),
        "table2_gain": gains[first & gains["violated"]].drop(columns="violated"),
        "table2_methods": gains,
        "table3_rate": rate_table(results, scenario),
        "policies": policy_table(evaluation, scenario),
        "comparison": comparison_table(evaluation, scenario),
        "sweeps": sweep_table(sweeps, scenario),
        "scores": score_table(evaluation, sweeps),
        "learners": learner_table(sweeps, scenario),
        "generalisation": generalisation_table(elsewhere, scenario),
        "bound": bound_table(bound_frame(results)),
        "gains": schedule_table(gain_schedules(results, scenario), scenario),
        "gain_methods": methods_table(results, scenario),
        "gain_grid": grid_table(results, scenario),
        "gain_sweeps": sweeps_table(results, scenario),
        "gain_stability": stability_table(results),
        "runs": pd.concat([evaluation, elsewhere], ignore_index=True),
    }
    written = []
    for name, table in tables.items():
        written.append(write_bytes(folder / f"{name}.csv", csv_text(table).encode()))
        if name in TITLES:  # `runs` has a row for every run: numbers to compute with, not to read
            shown = table[READ_COLUMNS[name]] if name in READ_COLUMNS else table
            text = markdown_text(shown, *TITLES[name])
            written.append(write_bytes(folder / f"{name}.md", text.encode()))
    return written


def parameter_table(scenario: Scenario, defaults: Path | None = None) -> pd.DataFrame:
    """Return every parameter with symbol, value, unit, origin and meaning.

    A value counts as the paper's only while it is the default's: a scenario that changes it
    assumes another.
    """
    path = CONFIG / "defaults.yaml" if defaults is None else defaults
    values = scenario_to_dict(scenario)
    defaults_values = scenario_to_dict(load_scenario(path, defaults=path))
    rows = []
    for note in scenario_notes(scenario, path):
        value, default = _at(values, note.key), _at(defaults_values, note.key)
        if note.key == "learners":
            value = {name: differing_keys(scenario, name) for name in scenario.learners}
        rows.append(
            {
                "key": note.key,
                "symbol": SYMBOLS.get(note.key, ""),
                "value": _plain(value),
                "unit": note.unit,
                "origin": note.origin if value == default else "assumed",
                "default": _plain(default),
                "meaning": note.meaning,
            }
        )
    return pd.DataFrame(rows)


def markdown_text(table: pd.DataFrame, title: str, note: str) -> str:
    """Return a table as Markdown, a mean and its bounds in one cell."""
    merged = [name for name in table.columns if {f"{name}_lo", f"{name}_hi"} <= set(table.columns)]
    bounds = {f"{name}_{end}" for name in merged for end in ("lo", "hi")}
    names = [name for name in table.columns if name not in bounds]
    lines = [f"# {title}", "", note, ""]
    lines.append("| " + " | ".join(str(name) for name in names) + " |")
    lines.append("|" + "|".join(_alignment(table, name) for name in names) + "|")
    for row in table.to_dict("records"):
        cells = [
            interval_text(row[name], row[f"{name}_lo"], row[f"{name}_hi"])
            if name in merged
            else cell_text(row[name])
            for name in names
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def interval_text(mean: float, lo: float, hi: float) -> str:
    """Return a mean and its interval, to two digits of its half width or of each number.

    A mean of 0 is given by its upper bound.
    """
    if not math.isfinite(mean):
        return "–"
    if math.isfinite(lo) and hi == math.inf:
        return f"{_rounded(mean, 3)} [{_rounded(lo, 2)}, ∞)"
    if not (math.isfinite(lo) and math.isfinite(hi)):
        return cell_text(mean) if math.isnan(lo) else f"{cell_text(mean)} [unbounded]"
    half = (hi - lo) / 2.0
    if half <= 1e-12 * abs(mean):
        return f"{cell_text(mean)} [±0]"
    if mean == lo == 0.0:
        return f"< {hi:.2g}"
    decimals = 1 - math.floor(math.log10(half))
    skewed = hi > 10.0 * lo > 0.0 or hi > 30.0 * abs(mean)
    if not -3 <= decimals <= 6 or skewed:  # each number with digits of its own
        return f"{_rounded(mean, 3)} [{_rounded(lo, 2)}, {_rounded(hi, 2)}]"
    decimals = max(0, decimals)
    return f"{mean:.{decimals}f} [{lo:.{decimals}f}, {hi:.{decimals}f}]"


def _rounded(value: float, digits: int) -> str:
    """Return a number with so many significant digits; no power of ten below a million."""
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if "e+" in text and abs(value) < 1e6 else text


def cell_text(value: Any) -> str:
    """Return a cell: numbers with four significant digits, no number as a dash."""
    if isinstance(value, bool) or not isinstance(value, float):
        return str(value).replace("|", "\\|")
    return f"{value:.4g}" if math.isfinite(value) else "–"


def _alignment(table: pd.DataFrame, name: str) -> str:
    return "---:" if pd.api.types.is_numeric_dtype(table[name]) else "---"


def _at(values: Any, key: str) -> Any:
    """Return the value at a dotted key, or null where another model has no such key."""
    for part in key.split("."):
        values = values.get(part)
    return values


def _plain(value: Any) -> str:
    if isinstance(value, list) and value and isinstance(value[0], list):
        return f"{len(value)} rows"
    return value if isinstance(value, str) else json.dumps(value)
