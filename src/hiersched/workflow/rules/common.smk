# What all rules share: the scenarios, checked before anything runs, and where files lie.

import shlex
import sys
from pathlib import Path

from hiersched.runs import dependencies, paths
from hiersched.runs.fingerprint import KERNEL_MODULE, PACKAGE_FOLDER, code_fingerprint
from hiersched.runs.gain_points import GAIN_SWEEPS
from hiersched.runs.variants import (
    CLASSICAL_GROUP,
    SWEPT_KEYS,
    check_variants,
    gain_designs,
    group_policies,
    group_runs,
    policy_groups,
    swept_policies,
)
from hiersched.scenario import (
    ScenarioError,
    load_scenario,
    parameter_notes,
)

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
        scenario = load_scenario(str(name))
        check_variants(scenario)
        if scenario.name in scenarios:
            raise ScenarioError(f"--config scenarios: {scenario.name} stands twice")
        scenarios[scenario.name] = scenario
        SOURCES[scenario.name] = str(name)
    return list(scenarios.values())


try:
    SCENARIOS = load_scenarios()
except ScenarioError as error:
    sys.exit(f"error: {error}")

BY_NAME = {scenario.name: scenario for scenario in SCENARIOS}
NOTES = "\n".join(map(str, parameter_notes()))
KERNELS = f"results/.kernels/{code_fingerprint(KERNEL_MODULE)[:16]}.txt"


wildcard_constraints:
    scenario="|".join(BY_NAME),
    design="schedule[a-z0-9._]*",


def folder(scenario):
    return f"results/{scenario.name}"


def inside(scenario, names):
    """Paths in the folder of a scenario, from paths relative to it."""
    return [f"{folder(scenario)}/{name}" for name in names]


def whole(names):
    """Outputs that must not be empty."""
    return [ensure(name, non_empty=True) for name in names]


def script(name):
    return SCRIPTS / f"{name}.py"


def groups_of(scenario, policies):
    """The groups that a list of policies needs."""
    return [group for group in policy_groups(scenario) if group_policies(scenario, policies, group)]


def groups_that_run(scenario):
    """The groups of which a policy runs anywhere."""
    return [group for group in policy_groups(scenario) if group_runs(scenario, group)]


def weights(scenario, group):
    """What a group of policies needs of the training."""
    if group == CLASSICAL_GROUP:
        return []
    return inside(scenario, paths.policy_files(scenario, group))


def runner(stage, group):
    """Script of a stage for a group of policies, and its further arguments."""
    if group == CLASSICAL_GROUP:
        return f"{stage}_classical", []
    return f"{stage}_learned", ["--learner", group]


# No job reads the resolved scenario that `rule resolve` writes: as an input it would make every job run whenever any
# value changes, and as `ancient` input worse: Snakemake does not look at the parameters of a job whose ancient input
# is about to be made. Jobs read the scenario file; if it is edited while they run, the next run repeats them.
# The folder of the scripts is not among the arguments: a package elsewhere does not make jobs run again.
def arguments(name, scenario, *more):
    """Script and arguments of a job."""
    given = ["--scenario", SOURCES[scenario.name], "--results", folder(scenario), *more]
    return " ".join([f"{name}.py", *(shlex.quote(word) for word in given)])
