"""Tables of the gain study: every method, the grid of weight and delay, the sweeps, the regions."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd

from hiersched.control import GainSchedule, spectral_radius_by_delay
from hiersched.experiments.points import GAINS, STUDY_PLANTS, Gain, baseline_method, experiments
from hiersched.scenario import Scenario, delay_steps, kinds_of_robots
from hiersched.scenario.schema import GainMethod
from hiersched.simulator.loop_gains import plant_of
from hiersched.study.metrics import OFF_TRACK_CM
from hiersched.study.paper import TABLE2
from hiersched.study.registry import has_gain_study, table
from hiersched.study.statistics import Interval, mean_interval, paired_log_ratio
from hiersched.study.study import Study
from hiersched.study.tables.text import FORCED_LOOP_NOTE, RATIO_NOTE, SEEDS_NOTE, TROUBLE_NOTE

_UNKNOWN = math.nan, math.nan


def has_gain_grid(scenario: Scenario) -> bool:
    """Whether weight and delay are swept."""
    return "gain_grid" in experiments(scenario)


def has_gain_sweeps(scenario: Scenario) -> bool:
    """Whether sampling interval and noise are swept."""
    return {"gain_grid", "gain_sampling_s", "gain_noise"} <= experiments(scenario).keys()


def delay_range(scenario: Scenario, bounds_s: tuple[float, float]) -> range:
    """Return the delays in samples between two bounds, capped at T_max as in the loop."""
    low, high = (
        min(delay_steps(bound, scenario.control.sampling_s), scenario.max_delay_steps)
        for bound in bounds_s
    )
    return range(low, high + 1)


def schedule_state(schedule: GainSchedule, delays: range) -> dict[str, Any]:
    """Say which gains are in force at some delays, and how many are certified for all robots."""
    kinds = schedule, *schedule.kinds
    states = dict.fromkeys(kind.status[delay] for delay in delays for kind in kinds)
    certified = sum(all(bool(kind.certified[delay]) for kind in kinds) for delay in delays)
    last = f"–{delays[-1]}" if len(delays) > 1 else ""
    return {
        "delay_steps": f"{delays[0]}{last}",
        "status": ", ".join(states),
        "certified": f"{certified} of {len(delays)}",
    }


@table(
    "gain_methods",
    title="Gain study: every method against the nominal gain, in the same worlds",
    note=f"{SEEDS_NOTE} {RATIO_NOTE} `violated` and `calm`: all such slots. `delay_steps`, "
    "`status`, `certified`: the delays there, the gains in force at them and how many of these are "
    "certified; gains follow the delay, so a method may also differ from the nominal gain in "
    f"calm slots. {TROUBLE_NOTE} {FORCED_LOOP_NOTE}",
    reads=("windows", "schedules", "growth"),
    when=has_gain_study,
)
def methods_table(study: Study) -> pd.DataFrame:
    """Return the tracking error of every method of the gain study, in the same worlds.

    A row for each violated slot, one for all of them and one for the calm slots: a method whose
    gain differs from the nominal one at short delays too pays, or gains, there.
    """
    scenario = study.scenario
    gain_study = scenario.gain_study
    violated = sorted(gain_study.violation_windows)
    calm = [slot for slot in range(1, gain_study.num_windows + 1) if slot not in violated]
    spans = {**{str(slot): [slot] for slot in violated}, "violated": violated, "calm": calm}
    robots = study.robots("gain_study")
    rows = []
    for method in gain_study.methods:
        own = _of_method(robots, scenario, method)
        schedule = study.schedule(study.point("gain_study", method).scenario)
        for slot, windows in spans.items():
            if not windows:
                continue
            bounds = gain_study.calm_delay_s if slot == "calm" else gain_study.violation_delay_s
            labels = {"method": method, "plant": STUDY_PLANTS[method], "slot": slot}
            row = {**labels, **compared(by_run(own[own["window"].isin(windows)]))}
            row |= schedule_state(schedule, delay_range(scenario, bounds))
            rows.append(row | method_loops(study, method, is_violated=slot != "calm"))
    return pd.DataFrame(rows)


def method_loops(study: Study, method: GainMethod, *, is_violated: bool) -> dict[str, Any]:
    """Return how the loops grow, with the nominal gain on a method's plant and with its gains."""
    first = baseline_method(study.scenario, method)
    return both_loops(study, "gain_study", {"nominal": first, "adjusted": method}, is_violated)


def both_loops(
    study: Study, experiment: str, values: Mapping[Gain, str], is_violated: bool
) -> dict[str, Any]:
    """Return how the loops with both gains grow, each at a point of the gain study."""
    span = "violated" if is_violated else "calm"
    row: dict[str, Any] = {}
    for gain, value in values.items():
        row |= study.loop_columns(experiment, value, gain, span=span, name=f"{gain}_loop")
    return row


def sweep_points_table(study: Study, experiment: str) -> pd.DataFrame:
    """Compare both gains at every point of a sweep of the gain study, in its violated windows.

    A row has the point's values, the delays in violated windows and the gains in force there, the
    columns of `compared`, and ``effect``: ``same gain``, else `effect_of` the ratio.
    """
    robots = study.robots(experiment)
    rows = []
    for value, group in robots[robots["window"] > 1].groupby("value", sort=False):
        point = study.point(experiment, str(value))
        assert point.delays is not None
        schedule, bounds = study.schedule(point.scenario), point.delays.violation_s
        delays = delay_range(point.scenario, bounds)
        control, robot = point.scenario.control, point.scenario.robot
        row = {
            "axis": experiment.removeprefix("gain_"),
            "value": point.value,
            "weight": control.weight,
            "sampling_s": control.sampling_s,
            "noise_position_m": robot.noise_position_m,
            "noise_heading_rad": robot.noise_heading_rad,
            "delay_lo_s": bounds[0],
            "delay_hi_s": bounds[1],
            **schedule_state(schedule, delays),
            **compared(by_run(group)),
        }
        own_gain = any(
            (kind.gains[delay] != kind.nominal).any() or kind.input_gains[delay].any()
            for kind in (schedule, *schedule.kinds)
            for delay in delays
        )
        ratio = Interval(row["ratio"], row["ratio_lo"], row["ratio_hi"])
        row |= both_loops(study, experiment, dict.fromkeys(GAINS, str(value)), is_violated=True)
        rows.append({**row, "effect": effect_of(ratio) if own_gain else "same gain"})
    return pd.DataFrame(rows)


def effect_of(ratio: Interval) -> str:
    """Return ``helps`` or ``hurts`` where the interval of a ratio of errors excludes 1."""
    if ratio.hi < 1.0:
        return "helps"
    return "hurts" if ratio.lo > 1.0 else "no difference"


def compared(runs: pd.DataFrame) -> dict[str, Any]:
    """Compare adjusted and nominal gain over the same seeds, which are in the same order."""
    by_gain = {gain: runs[runs["gain"] == gain] for gain in ("nominal", "adjusted")}
    nominal, adjusted = (group["error_cm"].to_numpy() for group in by_gain.values())
    row: dict[str, Any] = {
        **mean_interval(nominal).columns("nominal_cm"),
        **mean_interval(adjusted).columns("adjusted_cm"),
        **paired_log_ratio(adjusted, nominal).columns("ratio"),
        "seeds": len(nominal),
    }
    for name in ("off_track", "saturated"):
        for gain, group in by_gain.items():
            row[f"{gain}_{name}_share"] = float(group[name].mean())
    return row


@table(
    "gain_grid",
    title="Gain study: weight q against a constant delay in the violated window",
    note=f"{SEEDS_NOTE} {RATIO_NOTE} `effect`: helps or hurts where that interval excludes 1, "
    f"`same gain` where the nominal gain stays in force. {TROUBLE_NOTE} {FORCED_LOOP_NOTE}",
    reads=("windows", "schedules", "growth"),
    when=has_gain_grid,
)
def grid_table(study: Study) -> pd.DataFrame:
    """Return the grid of weight and delay: a row of `sweep_points_table` each."""
    points = sweep_points_table(study, "gain_grid")
    unused = ["axis", "value", "sampling_s", "noise_position_m", "noise_heading_rad", "delay_hi_s"]
    return points.rename(columns={"delay_lo_s": "delay_s"}).drop(columns=unused)


@table(
    "gain_sweeps",
    title="Gain study: sampling interval and measurement noise",
    note=f"{SEEDS_NOTE} {RATIO_NOTE} The first unstable constant delay is of the nominal gain, by "
    "the spectral radius of the lifted system; a dash: none up to the longest delay with a gain. "
    f"{TROUBLE_NOTE} {FORCED_LOOP_NOTE}",
    reads=("windows", "schedules", "stability", "growth"),
    when=has_gain_sweeps,
)
def sweeps_table(study: Study) -> pd.DataFrame:
    """Return the sweeps of sampling interval and noise, with the first unstable constant delay.

    That delay is of the nominal gain; there is none where the loop is stable up to T_max.
    """
    frames = [sweep_points_table(study, f"gain_{axis}") for axis in ("sampling_s", "noise")]
    points = pd.concat(frames, ignore_index=True)
    regions = stability_frame(study)
    exact = regions[regions["axis"] == "sampling_s"].set_index("value")
    first_s = (exact["delay_steps"] + 1.0) * exact.index
    unstable_s = points["sampling_s"].map(first_s.mask(exact["at_least"]))
    place = list(points.columns).index("sampling_s") + 1
    unstable_s = unstable_s.where(points["axis"] == "sampling_s")
    points.insert(place, "first_unstable_delay_s", unstable_s)
    return points.drop(columns=["value", "weight"])


def by_run(robots: pd.DataFrame) -> pd.DataFrame:
    """Return a row a run: mean error, and the shares of robots that got into trouble.

    ``off_track``: robots with more than `OFF_TRACK_CM` in one of the windows; ``saturated``: robots
    with a control at its limit in more than half of the slots of one. None is left out of the mean.
    """
    rows = []
    for (gain, seed), own in robots.groupby(["gain", "seed"], sort=False):
        num_robots = own["robot"].nunique()
        error_cm, saturated = (
            own[name].to_numpy().reshape(-1, num_robots) for name in ("error_cm", "saturated")
        )
        rows.append(
            {
                "gain": gain,
                "seed": seed,
                "error_cm": float(error_cm.mean()),
                "off_track": float((error_cm > OFF_TRACK_CM).any(axis=0).mean()),
                "saturated": float((saturated > 0.5).any(axis=0).mean()),
            }
        )
    return pd.DataFrame(rows)


def _of_method(robots: pd.DataFrame, scenario: Scenario, method: GainMethod) -> pd.DataFrame:
    """Return the windows of a method, and of the nominal gain on its plant."""
    values = {"nominal": baseline_method(scenario, method), "adjusted": method}
    parts = [
        robots[(robots["gain"] == gain) & (robots["value"] == value)]
        for gain, value in values.items()
    ]
    return pd.concat(parts)


@table(
    "gain_stability",
    title="Gain study: longest delays",
    note="Up to `delay_steps` samples: `exact`, the spectral radius of the lifted system is below "
    "1 at each constant delay; `c1`, `c2`, `c3`, every sequence of such delays is certified, all "
    "for the nominal gain; `adjusted`, exact, for the gain made for the longest delay of the "
    "grid. `at_least`: no longer delay was tried; a dash: not even without delay.",
    reads=("stability",),
    when=has_gain_grid,
)
def stability_table(study: Study) -> pd.DataFrame:
    """Return the stability regions, with what the file names in words."""
    return stability_frame(study).drop(columns="max_delay_steps")


def stability_frame(study: Study) -> pd.DataFrame:
    """Return the stability regions: a row an axis, value, plant and criterion.

    ``delay_steps`` is NaN where a criterion does not even hold without delay; ``delay_s`` is that
    many samples; ``at_least`` says that no longer delay was looked at.
    """
    frame = pd.DataFrame(study.stability)
    frame["delay_steps"] = frame["delay_steps"].astype(np.float64)
    frame["delay_s"] = frame["delay_steps"] * frame["sampling_s"]
    frame["at_least"] = frame["delay_steps"] == frame["max_delay_steps"]
    return frame


@table(
    "gains",
    title="Gain schedule",
    note="Deviation is the Frobenius norm of adjusted minus nominal gain; spectral radii are the "
    "largest over all constant delays up to T, of the gain in force and of the nominal one.",
    reads=("schedules",),
    when=has_gain_study,
)
def schedule_table(study: Study) -> pd.DataFrame:
    """Return the gain in force at every delay: status, deviation, certificate, spectral radii."""
    scenario = study.scenario
    rows = []
    for kind, variant, schedule in _schedules(study):
        loop = plant_of(variant).closed_loop(schedule.nominal)
        nominal_radii = spectral_radius_by_delay(*loop, schedule.max_delay_steps)
        for delay, certificate in enumerate(schedule.certificates):
            rows.append(
                {
                    "method": schedule.method,
                    **({"robot_kind": kind} if scenario.robot_kinds else {}),
                    "plant": schedule.kind,
                    "delay_steps": delay,
                    "delay_s": delay * schedule.sampling_s,
                    "status": schedule.status[delay],
                    "deviation": float(schedule.deviation[delay]),
                    "certified": bool(certificate.certified),
                    "criterion": certificate.criterion,
                    "spectral_radius": float(certificate.spectral_radii.max()),
                    "nominal_spectral_radius": float(nominal_radii[: delay + 1].max()),
                }
            )
    return pd.DataFrame(rows)


def _schedules(study: Study) -> Iterator[tuple[str, Scenario, GainSchedule]]:
    """Give the gains of every method, kind of robots after kind; the name of the first is empty."""
    for method in study_methods(study.scenario):
        variant = study.point("gain_study", method).scenario
        schedule = study.schedule(variant)
        names, kinds = ["", *sorted(variant.robot_kinds)], kinds_of_robots(variant)
        yield from zip(names, kinds, (schedule, *schedule.kinds), strict=True)


def study_methods(scenario: Scenario) -> list[GainMethod]:
    """List the methods of the gain study, the scenario's own first."""
    own = scenario.control.method
    return sorted(scenario.gain_study.methods, key=lambda method: method != own)


def runs_by_method(study: Study) -> Iterator[tuple[GainMethod, int, pd.DataFrame]]:
    """Give the runs (`by_run`) of every method in every window, with the nominal gain beside.

    Windows are counted from 1, methods begin with the scenario's own; those on one plant share the
    runs with the nominal gain.
    """
    robots = study.robots("gain_study")
    for method in study_methods(study.scenario):
        own = _of_method(robots, study.scenario, method)
        for slot, windows in own.groupby("window", sort=False):
            yield method, int(str(slot)), by_run(windows)


@table(
    "table2_gain",
    title="Table II: tracking error in the windows of violated delay",
    note=f"{SEEDS_NOTE} Root mean square over a window, mean over robots; slot 1 is the first "
    f"window. {RATIO_NOTE} The paper gives no unit: only its ratio compares. {FORCED_LOOP_NOTE}",
    reads=("windows", "growth"),
    when=has_gain_study,
)
def violated_table(study: Study) -> pd.DataFrame:
    """Return Table II: the violated windows under the scenario's own method."""
    gains = gain_table(study)
    own = gains["method"] == gains["method"].iloc[0]
    violated: pd.DataFrame = gains[own & gains["violated"]]
    return violated.drop(columns="violated")


@table(
    "table2_methods",
    title="Tracking error in every window of the gain study, by method",
    note=f"{SEEDS_NOTE} {RATIO_NOTE} {FORCED_LOOP_NOTE}",
    reads=("windows", "growth"),
    when=has_gain_study,
)
def gain_table(study: Study) -> pd.DataFrame:
    """Return the tracking error of every method and window: nominal, adjusted, paired ratio.

    Slots that are in the paper's Table II have its numbers beside them.
    """
    rows = []
    for method, slot, runs in runs_by_method(study):
        violated = slot in study.scenario.gain_study.violation_windows
        nominal, adjusted = TABLE2.get(slot, _UNKNOWN) if violated else _UNKNOWN
        row = compared(runs)
        first = ["nominal_cm", "adjusted_cm", "ratio", "ratio_lo", "ratio_hi"]
        bounds = [f"{gain}_cm_{end}" for gain in ("nominal", "adjusted") for end in ("lo", "hi")]
        rows.append(
            {
                "slot": slot,
                **{name: row[name] for name in (*first, *bounds, "seeds")},
                "method": method,
                "plant": STUDY_PLANTS[method],
                "violated": violated,
                "paper_nominal": nominal,
                "paper_adjusted": adjusted,
                "paper_ratio": adjusted / nominal,
                **method_loops(study, method, is_violated=violated),
            }
        )
    return pd.DataFrame(rows)
