# What all rules share: the scenarios, checked before anything runs, and where files lie.

import os
import re
import shlex
import sys
import textwrap
from pathlib import Path

from hiersched.core.extras import MissingExtraError
from hiersched.core.faults import printable
from hiersched.experiments import dependencies, files
from hiersched.experiments.feasible import load_study
from hiersched.experiments.fingerprint import PACKAGE_FOLDER, code_fingerprint, kernels_name
from hiersched.experiments.gains import designs, experiment_designs
from hiersched.experiments.points import (
    CLASSICAL_GROUP,
    TASK,
    cell_of,
    experiments,
    groups,
    trained_learners,
)
from hiersched.experiments.turns import begin_run
from hiersched.scenario import ScenarioError, parameter_notes
from hiersched.study.built_in import shown
from hiersched.study.measure import chain_files, measured_files, measured_groups, table_file
from hiersched.study.outputs import run_files, shown_files, source_files
from hiersched.study.registry import CLAIMS, FIGURES, TABLES
from hiersched.study.study import Study

SCRIPTS = PACKAGE_FOLDER / "workflow" / "scripts"
SOURCES = {}  # name of a scenario -> its file, or its name if it is a shipped one


def load_scenarios():
    unknown = sorted(set(config) - {"scenarios"})
    if unknown:
        raise ScenarioError(
            f"--config {', '.join(unknown)}: unknown; allowed: scenarios='[name, ...]'"
        )
    names = config.get("scenarios", ["paper"])
    names = names.split(",") if isinstance(names, str) else names
    if not isinstance(names, list) or not names:
        raise ScenarioError(f"--config scenarios={names!r}: must be a list of names or paths")
    scenarios = {}
    for name in names:
        scenario = load_study(str(name))
        if scenario.name in scenarios:
            raise ScenarioError(f"--config scenarios: {scenario.name} stands twice")
        scenarios[scenario.name] = scenario
        # However the path was written: the arguments of jobs are among what they depend on.
        SOURCES[scenario.name] = os.path.relpath(name) if Path(name).is_file() else str(name)
    return list(scenarios.values())


if workflow.is_main_process:  # not a job, which reads this file on its node once more
    begin_run(Path(".snakemake"))
try:
    SCENARIOS = load_scenarios()
except (ScenarioError, MissingExtraError) as error:
    sys.exit(f"error: {printable(str(error))}")

NOTES = "\n".join(map(str, parameter_notes()))
KERNELS = f"results/.kernels/{kernels_name()}.txt"


def folder(scenario):
    return f"results/{scenario.name}"


def inside(scenario, names):
    """Paths in the folder of a scenario, from paths relative to it."""
    return [f"{folder(scenario)}/{name}" for name in names]


def whole(scenario, names):
    """Outputs that must not be empty."""
    return [ensure(name, non_empty=True) for name in inside(scenario, names)]


def gain_files(scenario, names):
    return inside(scenario, map(files.gain_file, names))


def script(name):
    return SCRIPTS / f"{name}.py"


def spec(stage, values, name=None):
    """What a job depends on: values, and the code of its script, called like the stage unless named."""
    return dependencies.stage_spec(stage, values, script(name or stage))


# No job reads the resolved scenario that `rule resolve` writes: as an input it would make every job run whenever any
# value changes, and as `ancient` input worse: Snakemake does not look at the parameters of a job whose ancient input
# is about to be made. Jobs read the scenario file; if it is edited while they run, the next run repeats them.
# The folder of the scripts is not among the arguments: a package elsewhere does not make jobs run again.
def arguments(name, scenario, *more):
    """Script and arguments of a job."""
    given = ["--scenario", SOURCES[scenario.name], "--results", folder(scenario), *more]
    return " ".join([name, *(shlex.quote(word) for word in given)])


# Names of the jobs whose times are measured, by scenario; the page of a study lists them.
JOBS = {s.name: [] for s in SCENARIOS}


def benchmark_file(scenario, job):
    JOBS[scenario.name].append(job)
    return f"{folder(scenario)}/benchmarks/{job}.tsv"
