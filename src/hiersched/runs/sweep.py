"""Sweeps: one key varied at a time, every policy at every value in the same worlds."""

from __future__ import annotations

from pathlib import Path

from hiersched.runs import paths
from hiersched.runs.crossed import CrossedRows, Measure
from hiersched.runs.gains import load_gains
from hiersched.runs.logging import RunLabel, clear_logs, write_log
from hiersched.runs.policies import PolicySource, run_worlds, world_slots
from hiersched.runs.variants import (
    group_policies,
    swept_policies,
    swept_scenario,
    swept_values,
    value_text,
)
from hiersched.scenario import Scenario


def sweep(
    scenario: Scenario,
    results: Path,
    axis: str,
    group: str,
    source: PolicySource,
    measure: Measure | None = None,
) -> None:
    """Run and log a group of policies at every value of an axis.

    Parameters
    ----------
    scenario
        Section `sweeps` decides.
    results
        Folder of the study; the gain schedules lie in it.
    axis
        One of `variants.SWEPT_KEYS`.
    group
        Which policies: one of `variants.policy_groups`.
    source
        Where they are found by name.
    measure
        What measures the runs that are not logged (see `crossed`); without it they are not made.
    """
    seeds = scenario.sweeps.seeds
    policies = group_policies(scenario, swept_policies(scenario, axis), group)
    wanted = {results / name for name in paths.sweep_logs(scenario, axis, group)}
    for folder in {path.parent for path in wanted}:
        clear_logs(folder, wanted)
    for value in swept_values(scenario, axis):
        variant = swept_scenario(scenario, axis, value)
        schedule, gains = load_gains(
            results / paths.swept_gain_file(scenario, axis, value), variant
        )
        num_slots, warmup_slots = world_slots(scenario.sweeps, variant.radio.slot_s)
        for policy in policies:
            crossed = CrossedRows(measure, variant)
            for world in run_worlds(
                variant,
                gains,
                source(variant, policy),
                "sweep",
                seeds,
                num_slots,
                crossed=crossed.wanted,
            ):
                point = {"axis": axis, "value": value_text(value)}
                label = RunLabel(stage="sweep", policy=policy, seed=world.seed, **point)
                measured = world.after(warmup_slots)
                if not world.logged:
                    crossed.add(label, measured)
                    continue
                path = results / paths.sweep_log(axis, policy, value, world.seed)
                profile = scenario.log.sweep_profile
                write_log(path, variant, schedule, label, measured, profile=profile)
            crossed.write(results / paths.sweep_crossed(axis, policy, value))
        print(f"sweep {axis} = {value_text(value)}: {', '.join(policies)}", flush=True)
