"""Robots under forced delays, with nominal and adjusted gains, in the same worlds: Table II."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hiersched.core.randomness import STREAM_DELAY, draw_uniforms
from hiersched.runs import paths
from hiersched.runs.gain_points import gain_points
from hiersched.runs.gains import load_gains
from hiersched.runs.logging import RunLabel, clear_logs, log_block, open_log
from hiersched.runs.policies import seed_worlds
from hiersched.runs.variants import (
    STUDY_GAINS,
    baseline_method,
    design_of,
    study_scenario,
)
from hiersched.scenario import Scenario
from hiersched.simulator import Simulator


def forced_delays(
    scenario: Scenario,
    keys: NDArray[np.uint64],
    num_slots: int,
    num_robots: int,
    *,
    violation_windows: Collection[int] | None = None,
    violation_delay_s: tuple[float, float] | None = None,
) -> NDArray[np.float64]:
    """Draw the network delays of the study, shape (E, T, R), s: uniform per slot and robot.

    Long in the violation windows (1 = the first), short elsewhere. They depend on the worlds alone,
    so all gains meet the same. Windows and bounds are those of Table II unless given.
    """
    study = scenario.gain_study
    windows = study.violation_windows if violation_windows is None else violation_windows
    bounds = study.violation_delay_s if violation_delay_s is None else violation_delay_s
    slots_per_window = round(scenario.robot.window_s / scenario.radio.slot_s)
    violation = np.isin(np.arange(num_slots) // slots_per_window + 1, list(windows))
    low = np.where(violation, bounds[0], study.calm_delay_s[0])
    high = np.where(violation, bounds[1], study.calm_delay_s[1])
    uniform = np.empty((len(keys), num_slots, num_robots))
    for env, key in enumerate(keys):
        for slot in range(num_slots):
            draw_uniforms(key, STREAM_DELAY, slot, 0, uniform[env, slot])
    return low[:, None] + (high - low)[:, None] * uniform


def delays_of_run(
    variant: Scenario, axis: str, value: str, keys: NDArray[np.uint64], num_slots: int
) -> NDArray[np.float64]:
    """Draw the delays of a run once more, shape (E, T, R) [s].

    Parameters
    ----------
    variant
        The scenario that was run.
    axis, value
        Those of its log: the point of a sweep, empty for Table II.
    keys
        Worlds, shape (E,).
    num_slots
        Slots from the first on.

    Raises
    ------
    ValueError
        If there is no such point.
    """
    num_robots = variant.users.num_urllc
    if not axis:
        return forced_delays(variant, keys, num_slots, num_robots)
    bounds = {point.value: point.violation_delay_s for point in gain_points(variant, axis)}
    if value not in bounds:
        raise ValueError(f"{axis} = {value!r}: must be one of {', '.join(bounds)}")
    return _sweep_delays(variant, keys, num_slots, num_robots, bounds[value])


def _sweep_delays(
    scenario: Scenario,
    keys: NDArray[np.uint64],
    num_slots: int,
    num_robots: int,
    violation_delay_s: tuple[float, float],
) -> NDArray[np.float64]:
    """Draw the delays of a sweep's point: the first window is calm, the others are violated."""
    return forced_delays(
        scenario,
        keys,
        num_slots,
        num_robots,
        violation_windows=range(2, scenario.gain_study.sweep_windows + 1),
        violation_delay_s=violation_delay_s,
    )


def gain_study(scenario: Scenario, results: Path) -> None:
    """Run and log the robots for every method, gain and seed.

    Methods on one plant have the same nominal gain: it runs once.

    Parameters
    ----------
    scenario
        Section `gain_study` decides.
    results
        Folder of the study; the gain schedules lie in it.
    """
    study = scenario.gain_study
    num_slots = study.num_windows * round(scenario.robot.window_s / scenario.radio.slot_s)
    keys = seed_worlds("gain_study", study.seeds)
    delays = forced_delays(scenario, keys, num_slots, study.num_robots)
    wanted = {results / name for name in paths.gain_study_logs(scenario)}
    clear_logs(results / "gain_study", wanted)
    for method in study.methods:
        for gain in STUDY_GAINS:
            if gain == "nominal" and method != baseline_method(scenario, method):
                continue
            variant = study_scenario(scenario, method, gain)
            files = [results / paths.gain_study_log(method, gain, seed) for seed in study.seeds]
            _run(scenario, variant, results, keys, delays, files, axis="", value="")
            print(f"gain study {method} {gain}: {len(study.seeds)} seeds", flush=True)


def gain_sweep(scenario: Scenario, results: Path, axis: str) -> None:
    """Run and log the robots at every point of a sweep of the gain study, gain and seed.

    The first window is calm, the others are violated.

    Parameters
    ----------
    scenario
        Section `gain_study` decides.
    results
        Folder of the study; the gain schedules lie in it.
    axis
        What is swept: one of `GAIN_SWEEPS`.

    Raises
    ------
    ValueError
        On an unknown axis.
    """
    study = scenario.gain_study
    num_slots = study.sweep_windows * round(scenario.robot.window_s / scenario.radio.slot_s)
    keys = seed_worlds("gain_study", study.seeds)
    wanted = {results / name for name in paths.gain_sweep_logs(scenario, axis)}
    clear_logs(results / "gain_study" / axis, wanted)
    for point in gain_points(scenario, axis):
        delays = _sweep_delays(
            scenario, keys, num_slots, study.sweep_robots, point.violation_delay_s
        )
        for gain in STUDY_GAINS:
            variant = point.variant(gain)
            files = [
                results / paths.gain_sweep_log(axis, point.value, gain, seed)
                for seed in study.seeds
            ]
            _run(scenario, variant, results, keys, delays, files, axis=axis, value=point.value)
        print(f"gain study {axis} {point.value}: {len(study.seeds)} seeds", flush=True)


def _run(
    scenario: Scenario,
    variant: Scenario,
    results: Path,
    keys: NDArray[np.uint64],
    delays: NDArray[np.float64],
    files: list[Path],
    *,
    axis: str,
    value: str,
) -> None:
    """Run one loop in all worlds, shape (E, T, R) of delays, and write a log of each."""
    design = design_of(scenario, variant)
    schedule, gains = load_gains(results / paths.gain_file(design), variant)
    record = Simulator(variant, gains, keys, delays.shape[1]).run_robots(delays)
    for index, (seed, path) in enumerate(zip(scenario.gain_study.seeds, files, strict=True)):
        label = RunLabel(stage="gain_study", policy="none", seed=seed, axis=axis, value=value)
        with open_log(
            path,
            variant,
            schedule,
            label,
            profile=scenario.log.gain_study_profile,
            metadata={"method": variant.control.method},
        ) as writer:
            log_block(writer, variant, schedule, record.environment(index))
