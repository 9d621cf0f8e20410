# What all rules share: the scenarios, checked before anything runs, and where files lie.

import hashlib
import sys
from pathlib import Path

from hiersched.runs import paths, spec
from hiersched.runs.variants import (
    CLASSICAL_GROUP,
    GROUPS,
    LEARNED_GROUP,
    SWEPT_KEYS,
    check_variants,
    gain_designs,
    group_policies,
)
from hiersched.scenario import ScenarioError, load_scenario, parameter_notes


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
    return list(scenarios.values()), [str(name) for name in names]


def short_hash(text):
    return hashlib.sha256(text.encode()).hexdigest()[:16]


try:
    SCENARIOS, SOURCES = load_scenarios()
except ScenarioError as error:
    sys.exit(f"error: {error}")

BY_NAME = {scenario.name: scenario for scenario in SCENARIOS}
SOURCE_OF = dict(zip(BY_NAME, SOURCES, strict=True))
NOTES = "\n".join(map(str, parameter_notes()))
KERNELS_SPEC = spec.stage_spec("kernels", {}, Path("workflow/scripts/kernels.py"))
KERNELS = f"results/kernels/{short_hash(KERNELS_SPEC)}.txt"


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
    return Path("workflow/scripts") / f"{name}.py"


def groups_of(policies):
    """The groups that a list of policies needs."""
    return [group for group in GROUPS if group_policies(policies, group)]


def weights(scenario, group):
    """What a group of policies needs of the training."""
    return inside(scenario, paths.policy_files(scenario)) if group == LEARNED_GROUP else []


def checkpoints(scenario):
    """Folder for the checkpoints of one training: other code or another scenario never meets them."""
    training = spec.stage_spec("train", spec.scenario_values(scenario), script("train"))
    return f"{folder(scenario)}/checkpoints/{short_hash(training)}"


def resolved(scenario):
    # A new scenario file is no reason to run: each rule says in `spec` what it depends on.
    return ancient(f"{folder(scenario)}/{paths.SCENARIO}")
