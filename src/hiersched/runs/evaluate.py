"""Evaluation: every policy in the same held-out worlds."""

from __future__ import annotations

from pathlib import Path

from hiersched.runs import paths
from hiersched.runs.crossed import CrossedRows, Measure
from hiersched.runs.gains import load_gains
from hiersched.runs.logging import RunLabel, clear_logs, write_log
from hiersched.runs.policies import PolicySource, run_worlds, world_slots
from hiersched.runs.variants import group_policies
from hiersched.scenario import Scenario


def evaluate(
    scenario: Scenario,
    results: Path,
    group: str,
    source: PolicySource,
    measure: Measure | None = None,
) -> None:
    """Run and log a group of policies; every policy runs in all worlds as one batch.

    Of a learner's policies one a world is logged, see `crossed`. The beginning of the first worlds
    is also logged in full: to look at, not to measure.

    Parameters
    ----------
    scenario
        Section `evaluate` decides.
    results
        Folder of the study; the scenario's gain schedule lies in it.
    group
        Which policies: one of `variants.policy_groups`.
    source
        Where they are found by name.
    measure
        What measures the runs that are not logged; without it they are not made.
    """
    schedule, gains = load_gains(results / paths.gain_file("schedule"), scenario)
    evaluation, slot_s = scenario.evaluate, scenario.radio.slot_s
    num_slots, warmup_slots = world_slots(evaluation, slot_s)
    full_slots = round(evaluation.full_log_s / slot_s)
    seeds, profile = evaluation.seeds, scenario.log.evaluate_profile
    for policy in group_policies(scenario, evaluation.policies, group):
        files = {seed: results / paths.evaluation_log(policy, seed) for seed in seeds}
        full_files = {seed: results / name for seed, name in paths.full_logs(scenario, policy)}
        clear_logs(files[seeds[0]].parent, {*files.values(), *full_files.values()})
        crossed = CrossedRows(measure, scenario)
        for world in run_worlds(
            scenario,
            gains,
            source(scenario, policy),
            "evaluate",
            seeds,
            num_slots,
            crossed=crossed.wanted,
        ):
            label = RunLabel(stage="evaluate", policy=policy, seed=world.seed)
            measured = world.after(warmup_slots)
            if not world.logged:
                crossed.add(label, measured)
                continue
            write_log(files[world.seed], scenario, schedule, label, measured, profile=profile)
            if world.seed in full_files:
                first = world.beginning(full_slots)
                path = full_files[world.seed]
                write_log(path, scenario, schedule, label, first, profile="full")
        crossed.write(results / paths.evaluation_crossed(policy))
        print(f"evaluate {policy}: {len(seeds)} worlds of {num_slots} slots", flush=True)
