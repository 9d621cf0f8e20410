"""Table II: robots under forced delays, with nominal and adjusted gains, in the same worlds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hiersched.randomness import STREAM_DELAY, draw_uniforms
from hiersched.runs import paths
from hiersched.runs.gains import load_gains
from hiersched.runs.logging import RunLabel, clear_logs, log_block, open_log
from hiersched.runs.policies import seed_worlds
from hiersched.runs.variants import STUDY_GAINS, STUDY_PLANTS, design_of, study_scenario
from hiersched.scenario import Scenario
from hiersched.simulator import Simulator


def forced_delays(
    scenario: Scenario, keys: NDArray[np.uint64], num_slots: int, num_robots: int
) -> NDArray[np.float64]:
    """Draw the network delays of the study, shape (E, T, R), s: uniform per slot and robot.

    Long in the violation windows (1 = the first), short elsewhere. They depend on the worlds alone,
    so both gains meet the same.
    """
    study = scenario.gain_study
    slots_per_window = round(scenario.robot.window_s / scenario.radio.slot_s)
    violation = np.isin(np.arange(num_slots) // slots_per_window + 1, study.violation_windows)
    low = np.where(violation, study.violation_delay_s[0], study.calm_delay_s[0])
    high = np.where(violation, study.violation_delay_s[1], study.calm_delay_s[1])
    uniform = np.empty((len(keys), num_slots, num_robots))
    for env, key in enumerate(keys):
        for slot in range(num_slots):
            draw_uniforms(key, STREAM_DELAY, slot, 0, uniform[env, slot])
    return low[:, None] + (high - low)[:, None] * uniform


def gain_study(scenario: Scenario, results: Path) -> None:
    """Run and log the robots for every method, gain and seed.

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
    for method in STUDY_PLANTS:
        for gain in STUDY_GAINS:
            variant = study_scenario(scenario, method, gain)
            schedule, gains = load_gains(
                results / paths.gain_file(design_of(scenario, variant)), variant
            )
            record = Simulator(variant, gains, keys, num_slots).run_robots(delays)
            for index, seed in enumerate(study.seeds):
                with open_log(
                    results / paths.gain_study_log(method, gain, seed),
                    variant,
                    schedule,
                    RunLabel(stage="gain_study", policy="none", seed=seed),
                    profile=scenario.log.sweep_profile,
                    metadata={"method": method},
                ) as writer:
                    log_block(writer, variant, schedule, record.environment(index))
            print(f"gain study {method} {gain}: {len(study.seeds)} seeds", flush=True)
