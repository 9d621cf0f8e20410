"""Tables of the study of the task: gains at equal eMBB throughput, knobs, curves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from hiersched.experiments.points import REFERENCE, TASK, TUNED, experiments
from hiersched.study.registry import has_pareto, has_task_learners, has_task_study, table
from hiersched.study.samples import paired, sample_of
from hiersched.study.statistics import (
    Interval,
    holm,
    log_ratios,
    p_value,
    paired_log_ratio,
    skewed_interval,
)
from hiersched.study.study import Study
from hiersched.study.tables.text import LOOP_NOTE, RATIO_NOTE
from hiersched.study.task import (
    P99,
    RMS,
    best_blind,
    best_family,
    embb_share,
    first_aware,
    keeps_limit,
    kind_of,
    line_of,
    load_of,
    loop_at,
    mean_of,
    network_share,
    runs_of,
    task_learners_of,
    twin_of,
)

RATIOS = {"rms": RMS, "p99": P99}
"""Names of ratios of tracking errors."""
SIDE_BY_SIDE = (
    *("urllc_on_time_share", "urllc_late_share", "superseded_share", "embb_late_share"),
    *("set_point_age_s", "set_point_age_p99_s", "off_track_slots_share", "horizon_s"),
)
KNOBS_NOTE = (
    "Knobs are chosen in design worlds, whose runs are in no other table: of those that keep the "
    "eMBB limit the one with the least error (`experiments.tune`)."
)


def ratio_columns(study: Study, cell: str, policy: str, other: str | None, name: str) -> Any:
    """Return columns of the ratios of a policy's errors to another's in the same worlds."""
    row: dict[str, Any] = {name: other or ""}
    for short, measure in RATIOS.items():
        interval, p = Interval(np.nan, np.nan, np.nan), np.nan
        if other is not None and other != policy:
            pair = paired(runs_of(study, cell, policy), runs_of(study, cell, other), measure)
            interval, p = paired_log_ratio(*pair), p_value(log_ratios(*pair))
        row |= interval.columns(f"{short}_over_{name}")
        row[f"{short}_over_{name}_p"] = p
    return row


def in_range(ratio: Interval, expected: tuple[float, float] | None) -> str:
    """Say whether an interval lies in a range that was set beforehand, outside it, or neither."""
    if expected is None:
        return ""
    least, greatest = expected
    if least <= ratio.lo and ratio.hi <= greatest:
        return "met"
    return "missed" if ratio.hi < least or ratio.lo > greatest else "open"


TASK_LOOP_NOTE = f"{LOOP_NOTE} Here the delays are those of the first world."


@table(
    "task_gains",
    title="What knowing the task is worth at equal eMBB throughput",
    note=f"Held-out worlds. {KNOBS_NOTE} `blind` and `classical` are the best families that know "
    "nothing of the task, of all rules and of the classical ones, chosen in the design worlds too. "
    f"{RATIO_NOTE} `…_p_holm`: two-sided p-value of the ratio to `blind`, corrected for all cells "
    "in which the policy runs (Holm 1979); intervals are not corrected. `expected`: ranges that "
    "the scenario fixed beforehand for the first rule that knows the task; met, where the interval "
    "lies inside; missed, where it lies outside. `embb_share`: throughput over that of drift plus "
    "penalty with knob 1; `keeps_limit`: in the design worlds. `network_share`: the part of the "
    "mean square error that is over that of robots which know their references. On-time share: of "
    "all URLLC packets offered; a superseded one is neither on time nor late. Above capacity "
    f"queues grow, and errors with the horizon. {TASK_LOOP_NOTE}",
    reads=("task", "tunings", "growth"),
    when=has_task_study,
    columns=(
        *("cell", "policy", "kind", "knob", "tracking_rms_cm", "tracking_p99_cm", "blind"),
        *("rms_over_blind", "rms_over_blind_lo", "rms_over_blind_hi", "rms_over_blind_p_holm"),
        *("p99_over_blind", "p99_over_blind_lo", "p99_over_blind_hi", "classical"),
        *("rms_over_classical", "rms_over_classical_lo", "rms_over_classical_hi"),
        *("expected_rms", "rms_outcome", "expected_p99", "p99_outcome"),
        *("embb_share", "keeps_limit", "network_share", *SIDE_BY_SIDE, "loop_growth", "loop"),
    ),
)
def task_gains(study: Study) -> pd.DataFrame:
    """Return one row a cell and policy: errors against the best blind and classical families."""
    rows = []
    for cell, own in study.scenario.task_study.cells.items():
        blind = best_blind(study, cell)
        classical = best_family(study, cell, ("classical",))
        for policy in _policies(study, cell):
            runs, family = runs_of(study, cell, policy), _tuned(study, cell, policy)
            row: dict[str, Any] = {
                "cell": cell,
                "load": load_of(study.scenario, cell),
                "values": _text(line_of(study.scenario, cell)),
                "policy": policy,
                "kind": kind_of(study.scenario, policy),
                "knob": family.get("knob") or np.nan,
                **{name: mean_of(runs, name) for name in RATIOS.values()},
                **ratio_columns(study, cell, policy, blind, "blind"),
                **ratio_columns(study, cell, policy, classical, "classical"),
                **embb_share(study, cell, policy).columns("embb_share"),
                "keeps_limit": family.get("keeps_limit", ""),
                "network_share": network_share(study, cell, policy),
                **{name: mean_of(runs, name) for name in SIDE_BY_SIDE},
                **loop_at(study, cell, policy),
            }
            is_first = policy == first_aware(study.scenario, cell)
            is_first = is_first and keeps_limit(study, cell, policy)
            for short, expected in (("rms", own.expected_rms), ("p99", own.expected_p99)):
                expected = expected if is_first else None
                bounds = (row[f"{short}_over_blind{end}"] for end in ("", "_lo", "_hi"))
                row[f"expected_{short}"] = f"{expected[0]:g} to {expected[1]:g}" if expected else ""
                row[f"{short}_outcome"] = in_range(Interval(*bounds), expected)
            rows.append(row)
    frame = pd.DataFrame(rows)
    for short in RATIOS:
        by_policy = frame.groupby("policy", sort=False)[f"{short}_over_blind_p"]
        frame[f"{short}_over_blind_p_holm"] = by_policy.transform(lambda p: holm(p.to_numpy()))
    return frame


@table(
    "task_knobs",
    title="Knobs that design worlds have chosen",
    note=f"{KNOBS_NOTE} `embb_share`: throughput over that of drift plus penalty with knob 1, "
    "`least_embb_share` and `most_late` the limits; errors and shares are those of the design "
    "worlds. `edge`: the best knob lies at that end of what was tried, after widening. With the "
    f"knob in the held-out worlds: {TASK_LOOP_NOTE}",
    reads=("tunings", "growth"),
    when=has_task_study,
)
def task_knobs(study: Study) -> pd.DataFrame:
    """Return one row a cell and family: its knob and what it came to in the design worlds."""
    names = ("knob", "embb_share", "embb_late_share", RMS, "keeps_limit", "edge")
    return pd.DataFrame(
        {
            "cell": cell,
            "family": name,
            "key": family["key"] or "",
            **{key: _number(family[key]) for key in names},
            "tried": len(family["tried"]),
            "least_embb_share": tuning["limits"]["embb_share"],
            "most_late": _number(tuning["limits"]["embb_late_share"]),
            **loop_at(study, cell, name),
        }
        for cell, tuning in study.tunings.items()
        for name, family in tuning["families"].items()
    )


@table(
    "task_pareto",
    title="eMBB throughput against tracking error over the knobs",
    note="Held-out worlds: each family over a grid of its knob, at its tuned one (`tuned`), and "
    "what has no knob. `embb_share` as in `task_gains`. Errors are means, in brackets the 95 % "
    f"interval of a lognormal mean. {TASK_LOOP_NOTE}",
    reads=("task", "tunings", "growth"),
    when=has_pareto,
)
def task_pareto(study: Study) -> pd.DataFrame:
    """Return one row a cell with curves, policy and knob."""
    rows = []
    for cell, own in study.scenario.task_study.cells.items():
        if not own.pareto:
            continue
        for point in experiments(study.scenario)[f"{TASK}_{cell}"].points:
            for policy in point.policies or ():
                runs = runs_of(study, cell, policy, point.value)
                if not (point.tuned or point.value.startswith("knob")):
                    continue
                knob = _tuned(study, cell, policy).get("knob") if point.tuned else None
                rows.append(
                    {
                        "cell": cell,
                        "policy": policy,
                        "kind": kind_of(study.scenario, policy),
                        "tuned": point.value == TUNED,
                        "knob": (knob or np.nan) if point.tuned else runs["knob"].iloc[0],
                        **embb_share(study, cell, policy, point.value).columns("embb_share"),
                        "embb_late_share": mean_of(runs, "embb_late_share"),
                        **_error(runs).columns(RMS),
                        P99: mean_of(runs, P99),
                        **loop_at(study, cell, policy, point.value),
                    }
                )
    return pd.DataFrame(rows)


@table(
    "task_learners",
    title="What learning adds to a rule that knows the task",
    note=f"Held-out worlds, every trained policy in each. {KNOBS_NOTE} `aware` and `blind` are the "
    "best families that know the task and that do not, chosen in the design worlds too. `twin`: "
    "the learner that differs in `observe_demand` alone, seed by seed; it too observes the "
    "dexterity index, which says how well a robot has tracked. A learner runs as it was trained, "
    "at the load `trained_load`, in every cell; it has no knob and no limit there, so that its "
    "eMBB throughput and lateness stand beside those of `aware`; `keeps_limits`: whether its means "
    f"over the held-out worlds keep the limits of the cell. {RATIO_NOTE} `rms_seeds_std_cm`: "
    f"standard deviation of the training seeds' mean errors. {TASK_LOOP_NOTE}",
    reads=("task", "tunings", "growth"),
    when=has_task_learners,
    columns=(
        *("cell", "policy", "sees_task", "trained_load", "training_seeds", "tracking_rms_cm"),
        *("rms_seeds_std_cm", "tracking_p99_cm", "aware", "rms_over_aware", "rms_over_aware_lo"),
        *("rms_over_aware_hi", "p99_over_aware", "p99_over_aware_lo", "p99_over_aware_hi", "twin"),
        *("rms_over_twin", "rms_over_twin_lo", "rms_over_twin_hi", "blind", "rms_over_blind"),
        *("rms_over_blind_lo", "rms_over_blind_hi", "embb_share", "embb_share_aware"),
        *("embb_late_share", "embb_late_share_aware", "keeps_limits", "urllc_late_share"),
        *("loop_growth", "loop"),
    ),
)
def task_learners(study: Study) -> pd.DataFrame:
    """Return one row a cell and learner: errors against rules and against its twin."""
    rows = []
    for cell in study.scenario.task_study.cells:
        rivals = {
            "aware": best_family(study, cell, ("control-aware",)),
            "blind": best_blind(study, cell),
        }
        for policy in task_learners_of(study.scenario):
            runs, learning = runs_of(study, cell, policy), study.scenario.learned[policy]
            by_seed = sample_of(runs, RMS)
            aware, twin = rivals["aware"], twin_of(study.scenario, policy)
            row: dict[str, Any] = {
                "cell": cell,
                "policy": policy,
                "sees_task": learning.observe_demand,
                "trained_load": study.scenario.traffic.load,
                "training_seeds": len(learning.seeds),
                "rms_seeds_std_cm": np.nan,
                **{name: mean_of(runs, name) for name in RATIOS.values()},
                **embb_share(study, cell, policy).columns("embb_share"),
                "embb_share_aware": embb_share(study, cell, aware).mean if aware else np.nan,
                "embb_late_share_aware": (
                    mean_of(runs_of(study, cell, aware), "embb_late_share") if aware else np.nan
                ),
                "keeps_limits": _held_out_limits(study, cell, policy),
                **{name: mean_of(runs, name) for name in ("embb_late_share", "urllc_late_share")},
                **loop_at(study, cell, policy),
            }
            if by_seed.ndim == 2 and len(by_seed) > 1:
                row["rms_seeds_std_cm"] = float(by_seed.mean(1).std(ddof=1))
            for name, rival in {**rivals, "twin": twin}.items():
                row |= ratio_columns(study, cell, policy, rival, name)
            rows.append(row)
    return pd.DataFrame(rows)


@table(
    "task_superseding",
    title="What superseding alone is worth",
    note="The best family that knows nothing of the task where new set-points replace those that "
    "wait, against the best such family where they do not, each at its own tuned knob under the "
    f"same limits in the same worlds. {RATIO_NOTE} {TASK_LOOP_NOTE}",
    reads=("task", "tunings", "growth"),
    when=lambda scenario: bool(_superseding_pairs(scenario)),
)
def task_superseding(study: Study) -> pd.DataFrame:
    """Return one row a cell with superseding: its best blind family against that without."""
    rows = []
    for cell, other in _superseding_pairs(study.scenario).items():
        own, without = best_blind(study, cell), best_blind(study, other)
        if own is None or without is None:
            continue
        a, b = runs_of(study, cell, own), runs_of(study, other, without)
        row: dict[str, Any] = {"cell": cell, "policy": own}
        row |= {"without": other, "policy_without": without}
        for short, measure in RATIOS.items():
            row |= paired_log_ratio(*paired(a, b, measure)).columns(f"{short}_ratio")
        shares = ("urllc_on_time_share", "superseded_share", "embb_late_share")
        row |= {RMS: mean_of(a, RMS), **{name: mean_of(a, name) for name in shares}}
        row |= loop_at(study, cell, own)
        rows.append({**row, "loop_without": loop_at(study, other, without)["loop"]})
    return pd.DataFrame(rows)


def _superseding_pairs(scenario: Any) -> dict[str, str]:
    """Return cells with superseding, each with that which differs in nothing else."""
    key, cells = "robot.superseding", scenario.task_study.cells
    bare = {c: {k: v for k, v in own.values.items() if k != key} for c, own in cells.items()}
    plain = [cell for cell, own in cells.items() if key not in own.values]
    pairs = {}
    for cell, own in cells.items():
        same = (c for c in plain if bare[c] == bare[cell] and cells[c].bound_late == own.bound_late)
        other = next(same, None)
        if own.values.get(key, "none") != "none" and other is not None:
            pairs[cell] = other
    return pairs


def _policies(study: Study, cell: str) -> list[str]:
    first, *_ = experiments(study.scenario)[f"{TASK}_{cell}"].points
    return list(first.policies or ())


def _tuned(study: Study, cell: str, policy: str) -> dict[str, Any]:
    if policy == REFERENCE:
        return {"knob": 1.0, "keeps_limit": True}
    family: dict[str, Any] = study.tunings[cell]["families"].get(policy, {})
    return family


def _held_out_limits(study: Study, cell: str, policy: str) -> bool:
    """Whether means over the held-out worlds keep the limits that knobs keep in design worlds."""
    task, reference = study.scenario.task_study, runs_of(study, cell, REFERENCE)
    late = mean_of(runs_of(study, cell, policy), "embb_late_share")
    most = mean_of(reference, "embb_late_share") + task.embb_late_excess
    in_time = late <= most or not task.cells[cell].bound_late
    return in_time and embb_share(study, cell, policy).mean >= task.embb_share


def _number(value: Any) -> Any:
    return np.nan if value is None else value


def _error(runs: pd.DataFrame) -> Interval:
    return skewed_interval(sample_of(runs, RMS))


def _text(values: dict[str, object]) -> str:
    return ", ".join(f"{key} = {value}" for key, value in values.items())
