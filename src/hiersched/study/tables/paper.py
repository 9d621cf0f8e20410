"""Tables I and III of the paper."""

from __future__ import annotations

import json
import math
from typing import Any

import pandas as pd

from hiersched.experiments.points import BASELINE
from hiersched.scenario import load_scenario, scenario_notes, scenario_to_dict
from hiersched.scenario.load import DEFAULTS
from hiersched.study.paper import SYMBOLS, TABLE3
from hiersched.study.registry import compares_rates, own_and_baseline, table
from hiersched.study.statistics import mean_interval, paired_log_ratio
from hiersched.study.study import Study
from hiersched.study.tables.policies import differing_keys
from hiersched.study.tables.text import LOGGED_NOTE, RATIO_NOTE, SEEDS_NOTE


@table(
    "table1_parameters",
    title="Table I: parameters",
    note="`paper`: the value stands in the paper; `assumed`: it does not, or this scenario departs "
    "from it.",
    reads=(),
)
def parameter_table(study: Study) -> pd.DataFrame:
    """Return every parameter with symbol, value, unit, origin and meaning.

    A value counts as the paper's only while it is the default's: a scenario that changes it
    assumes another.
    """
    scenario = study.scenario
    values = scenario_to_dict(scenario)
    defaults = scenario_to_dict(load_scenario(DEFAULTS))
    rows = []
    for note in scenario_notes(scenario):
        value, default = _at(values, note.key), _at(defaults, note.key)
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


def _at(values: Any, key: str) -> Any:
    """Return the value at a dotted key, or null where another scenario has no such key.

    The name of an axis may have dots of its own.
    """
    if key.startswith("sweeps.axes."):
        name, _, last = key.removeprefix("sweeps.axes.").rpartition(".")
        return values["sweeps"]["axes"].get(name, {}).get(last)
    for part in key.split("."):
        values = values.get(part) if isinstance(values, dict) else None
    return values


def _plain(value: Any) -> str:
    if isinstance(value, list) and value and isinstance(value[0], list):
        return f"{len(value)} rows"
    return value if isinstance(value, str) else json.dumps(value)


@table(
    "table3_rate",
    title="Table III: mean data rate of the URLLC users",
    note=f"{SEEDS_NOTE} Slot 1 is the first slot of a run; `mean` is behind the warm-up. The "
    "channel gain is the mean of |h|² over URLLC users and PRBs, 2 s² in expectation; the paper "
    f"does not define its own. {RATIO_NOTE} {LOGGED_NOTE}",
    reads=("slots",),
    when=compares_rates,
)
def rate_table(study: Study) -> pd.DataFrame:
    """Return Table III: mean URLLC rate of learned policy and PF at three slots and over all.

    The first slot is slot 1; all is what lies behind the warm-up. The channel gain is the mean of
    the squared fading amplitude over URLLC users and PRBs, the same for both policies.
    """
    scenario = study.scenario
    slots = study.measures("slots")
    slots = slots[slots["experiment"] == "evaluate"]
    learned = scenario.learning.algorithm
    present = own_and_baseline(scenario, scenario.evaluate.policies)
    rows = []
    for slot in (*TABLE3, "mean"):
        here = slots[slots["slot"].isna() if slot == "mean" else slots["slot"] == slot]
        if here.empty:
            continue  # the runs are shorter
        own = {p: here[here["policy"] == p].set_index("seed") for p in present}
        rates = {p: own[p]["urllc_rate_mbps"].to_numpy() for p in present}
        row: dict[str, Any] = {"slot": slot, "seeds": len(scenario.evaluate.seeds)}
        row |= mean_interval(own[present[0]]["channel_gain"]).columns("channel_gain")
        for name, policy in (("drl", learned), ("pf", BASELINE)):
            if policy in rates:
                row |= mean_interval(rates[policy]).columns(f"{name}_mbps")
        if len(rates) == 2:
            row |= paired_log_ratio(rates[learned], rates[BASELINE]).columns("ratio")
        printed = TABLE3.get(slot) if isinstance(slot, int) else None
        for field in ("channel_gain", "drl_mbps", "pf_mbps"):
            row[f"paper_{field}"] = getattr(printed, field) if printed else math.nan
        rows.append(row)
    return pd.DataFrame(rows)
