"""Evaluation: every policy in the same held-out worlds, one log a policy and world."""

from __future__ import annotations

from pathlib import Path

from hiersched.runs import paths
from hiersched.runs.gains import load_gains
from hiersched.runs.logging import RunLabel, clear_logs, write_log
from hiersched.runs.policies import PolicyRunner
from hiersched.runs.variants import group_policies
from hiersched.scenario import Scenario


def evaluate(scenario: Scenario, results: Path, group: str, run: PolicyRunner) -> None:
    """Run and log a group of policies; every policy runs in all worlds as one batch.

    Parameters
    ----------
    scenario
        Section `evaluate` decides.
    results
        Folder of the study; the scenario's gain schedule lies in it.
    group
        Which policies: one of `variants.policy_groups`.
    run
        How they are run.
    """
    schedule, gains = load_gains(results / paths.gain_file("schedule"), scenario)
    num_slots = round(scenario.evaluate.duration_s / scenario.radio.slot_s)
    seeds = scenario.evaluate.seeds
    for policy in group_policies(scenario, scenario.evaluate.policies, group):
        files = {seed: results / paths.evaluation_log(policy, seed) for seed in seeds}
        clear_logs(files[seeds[0]].parent, set(files.values()))
        for world in run(scenario, gains, policy, "evaluate", seeds, num_slots):
            label = RunLabel(stage="evaluate", policy=policy, seed=world.seed)
            profile = scenario.log.evaluate_profile
            write_log(files[world.seed], scenario, schedule, label, world, profile=profile)
        print(f"evaluate {policy}: {len(seeds)} worlds of {num_slots} slots", flush=True)
