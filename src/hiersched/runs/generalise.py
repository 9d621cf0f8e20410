"""Cells of other sizes: policies run there as they are, beside the schedulers."""

from __future__ import annotations

from pathlib import Path

from hiersched.runs import paths
from hiersched.runs.crossed import CrossedRows, Measure
from hiersched.runs.gains import load_gains
from hiersched.runs.logging import RunLabel, clear_logs, write_log
from hiersched.runs.policies import PolicySource, run_worlds, world_slots
from hiersched.runs.variants import cell_scenario, cell_text, group_policies
from hiersched.scenario import Scenario


def generalise(
    scenario: Scenario,
    results: Path,
    group: str,
    source: PolicySource,
    measure: Measure | None = None,
) -> None:
    """Run and log a group of policies in every cell.

    Parameters
    ----------
    scenario
        Section `generalise` decides.
    results
        Folder of the study; the scenario's gain schedule lies in it.
    group
        Which policies: one of `variants.policy_groups`.
    source
        Where they are found by name.
    measure
        What measures the runs that are not logged (see `crossed`); without it they are not made.
    """
    seeds = scenario.generalise.seeds
    num_slots, warmup_slots = world_slots(scenario.generalise, scenario.radio.slot_s)
    wanted = {results / name for name in paths.cell_logs(scenario, group)}
    for folder in {path.parent for path in wanted}:
        clear_logs(folder, wanted)
    for cell in scenario.generalise.cells:
        variant = cell_scenario(scenario, cell)
        schedule, gains = load_gains(results / paths.gain_file("schedule"), variant)
        policies = group_policies(scenario, scenario.generalise.policies, group)
        for policy in policies:
            crossed = CrossedRows(measure, variant)
            for world in run_worlds(
                variant,
                gains,
                source(variant, policy),
                "generalise",
                seeds,
                num_slots,
                crossed=crossed.wanted,
            ):
                point = {"axis": "cell", "value": cell_text(cell)}
                label = RunLabel(stage="generalise", policy=policy, seed=world.seed, **point)
                measured = world.after(warmup_slots)
                if not world.logged:
                    crossed.add(label, measured)
                    continue
                path = results / paths.cell_log(cell, policy, world.seed)
                profile = scenario.log.sweep_profile
                write_log(path, variant, schedule, label, measured, profile=profile)
            crossed.write(results / paths.cell_crossed(cell, policy))
        print(f"generalise {cell_text(cell)}: {', '.join(policies)}", flush=True)
