"""Files that a scenario asks for, relative to the folder of its study."""

from __future__ import annotations

from hiersched.experiments import files
from hiersched.experiments.gains import designs
from hiersched.experiments.points import experiments, groups, trained_learners
from hiersched.scenario import Scenario
from hiersched.study.built_in import shown
from hiersched.study.registry import CLAIMS, FIGURES, TABLES
from hiersched.study.study import Study


def shown_files(scenario: Scenario) -> list[str]:
    """List everything that a study shows: figures, tables to compute with, verdicts."""
    names = [f"figures/{name}.{end}" for name in shown(FIGURES, scenario) for end in ("svg", "png")]
    names += [f"tables/{name}.csv" for name in shown(TABLES, scenario)]
    return names + list(files.CLAIMS if shown(CLAIMS, scenario) else ())


def run_files(scenario: Scenario) -> list[str]:
    """List every log of a study, and the measures of runs that have none."""
    names = [
        name
        for e in experiments(scenario).values()
        for group in groups(scenario, e)
        for name in files.group_files(scenario, e, group)
    ]
    for learner in trained_learners(scenario):
        names += files.learner_logs(scenario, learner)
    return names


def source_files(scenario: Scenario) -> list[str]:
    """List what the things shown are made of: measures that they read, gains, tuned knobs."""
    names = [
        name
        for registry in (TABLES, FIGURES, CLAIMS)
        for thing in shown(registry, scenario).values()
        for name in Study.sources(scenario, thing.reads)
    ]
    names += map(files.gain_file, designs(scenario))
    names += map(files.tuning_file, scenario.task_study.cells)
    return sorted(set(names))
