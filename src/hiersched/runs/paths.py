"""Where the files of a study lie, relative to its folder ``results/<scenario>``."""

from __future__ import annotations

from hiersched.runs.gain_points import GAIN_SWEEPS, gain_points
from hiersched.runs.variants import (
    STUDY_GAINS,
    SWEPT_KEYS,
    Cell,
    baseline_method,
    cell_text,
    design_of,
    gain_designs,
    group_policies,
    group_runs,
    policy_groups,
    study_scenario,
    swept_policies,
    swept_scenario,
    swept_values,
    value_text,
    weighted_scenario,
)
from hiersched.scenario import Scenario

SCENARIO = "scenario.yaml"
CHECKPOINTS = "checkpoints"
STABILITY = "gains/stability.json"

RUNS = "tables/runs.csv"
BOUND = "bound/slots.csv"
CLAIMS = ("claims.json", "claims.md")

FIGURES = (
    "fig2_rewards",
    "fig3_queues",
    "fig4_rate_cdf",
    "fig5_rayleigh",
    "fig6_sampling",
    "fig7_dexterity",
    "fig8_violations",
    "figX_learning",
    "figX_learners",
    "figX_load",
    "figX_delay",
    "figX_pareto",
    "figX_bound",
    "figX_generalise",
    "figX_gain",
    "figX_gain_grid",
    "figX_gain_sweeps",
    "figX_gain_traces",
    "figX_gain_stability",
)
TABLES = (
    "table1_parameters",
    "table2_gain",
    "table2_methods",
    "table3_rate",
    "policies",
    "comparison",
    "sweeps",
    "scores",
    "learners",
    "generalisation",
    "bound",
    "gains",
    "gain_methods",
    "gain_grid",
    "gain_sweeps",
    "gain_stability",
)


def measures_file(group: str) -> str:
    """Measures of every run of a group of policies."""
    return f"measures/{group}.csv"


def measures_files(scenario: Scenario) -> list[str]:
    """List the measures of all groups of policies that run."""
    groups = policy_groups(scenario)
    return [measures_file(group) for group in groups if group_runs(scenario, group)]


def measured_logs(scenario: Scenario, group: str) -> list[str]:
    """List the logs from which the measures of a group come."""
    names = [*evaluation_logs(scenario, group), *cell_logs(scenario, group)]
    for axis in SWEPT_KEYS:
        names += sweep_logs(scenario, axis, group)
    return names


def measured_files(scenario: Scenario, group: str) -> list[str]:
    """List logs, and measures of runs without one, from which the measures of a group come."""
    names = [*measured_logs(scenario, group), *evaluation_crosses(scenario, group)]
    for axis in SWEPT_KEYS:
        names += sweep_crosses(scenario, axis, group)
    return [*names, *cell_crosses(scenario, group)]


def is_crossed(scenario: Scenario, policy: str) -> bool:
    """Whether a policy is several, one a training seed, of which one a world is logged."""
    return policy in scenario.learned and len(scenario.learned[policy].seeds) > 1


def gain_file(design: str) -> str:
    """Gain schedule by its name among `gain_designs`."""
    return f"gains/{design}.json"


def all_gain_files(scenario: Scenario) -> list[str]:
    """List every gain schedule of a study."""
    return [gain_file(design) for design in gain_designs(scenario)]


def swept_gain_file(scenario: Scenario, axis: str, value: float | str) -> str:
    """Gain schedule of one point of a sweep."""
    return gain_file(design_of(scenario, swept_scenario(scenario, axis, value)))


def swept_gain_files(scenario: Scenario, axis: str) -> list[str]:
    """List the gain schedules that a sweep needs, each once."""
    values = swept_values(scenario, axis)
    return list(dict.fromkeys(swept_gain_file(scenario, axis, value) for value in values))


def progress_file(learner: str) -> str:
    """Learning curves of a learner."""
    return f"train/{learner}/progress.csv"


def policy_file(learner: str, seed: int) -> str:
    """Weights of the policy of a training seed."""
    return f"train/{learner}/policy_seed{seed}.pt"


def policy_files(scenario: Scenario, learner: str) -> list[str]:
    """List the weights of all training seeds of a learner."""
    return [policy_file(learner, seed) for seed in scenario.learned[learner].seeds]


def training_log(learner: str, seed: int) -> str:
    """Log of the training of one seed."""
    return f"train/{learner}/seed{seed}.mcap"


def training_logs(scenario: Scenario, learner: str) -> list[str]:
    """List the logs of the training of all seeds of a learner."""
    return [training_log(learner, seed) for seed in scenario.learned[learner].seeds]


def checkpoint_log(learner: str, seed: int) -> str:
    """Log of the policies of one seed without noise, at the start and during training."""
    return f"train/{learner}/checkpoints_seed{seed}.mcap"


def checkpoint_logs(scenario: Scenario, learner: str) -> list[str]:
    """List the logs of the policies of all seeds of a learner during training, without noise."""
    return [checkpoint_log(learner, seed) for seed in scenario.learned[learner].seeds]


def all_training_logs(scenario: Scenario) -> list[str]:
    """List the logs of the training of all learners, those without noise among them."""
    return [
        name
        for learner in scenario.learned
        for name in (*training_logs(scenario, learner), *checkpoint_logs(scenario, learner))
    ]


def evaluation_log(policy: str, seed: int) -> str:
    """Log of a policy in a held-out world."""
    return f"eval/{policy}/seed{seed}.mcap"


def evaluation_logs(scenario: Scenario, group: str) -> list[str]:
    """List the logs of the evaluation of a group of policies."""
    return [
        evaluation_log(policy, seed)
        for policy in group_policies(scenario, scenario.evaluate.policies, group)
        for seed in scenario.evaluate.seeds
    ]


def evaluation_crossed(policy: str) -> str:
    """Measures of a learner's policies in the held-out worlds in which they are not logged."""
    return f"eval/{policy}/crossed.csv"


def full_logs(scenario: Scenario, policy: str) -> list[tuple[int, str]]:
    """List seed and path of the logs that show the beginning of a policy's worlds in full."""
    seeds = scenario.evaluate.seeds[: scenario.evaluate.full_logs]
    return [(seed, f"eval/{policy}/seed{seed}_full.mcap") for seed in seeds]


def evaluation_outputs(scenario: Scenario, group: str) -> list[str]:
    """List all files that the evaluation of a group of policies writes."""
    policies = group_policies(scenario, scenario.evaluate.policies, group)
    full = [name for policy in policies for _, name in full_logs(scenario, policy)]
    return [*evaluation_logs(scenario, group), *full, *evaluation_crosses(scenario, group)]


def evaluation_crosses(scenario: Scenario, group: str) -> list[str]:
    """List the measures of a group in the held-out worlds in which it is not logged."""
    policies = group_policies(scenario, scenario.evaluate.policies, group)
    return [evaluation_crossed(policy) for policy in policies if is_crossed(scenario, policy)]


def sweep_log(axis: str, policy: str, value: float | str, seed: int) -> str:
    """Log of a policy at one point of a sweep."""
    return f"sweep/{axis}/{policy}/{value_text(value)}_seed{seed}.mcap"


def sweep_crossed(axis: str, policy: str, value: float | str) -> str:
    """Measures of a learner's policies at one point of a sweep where they are not logged."""
    return f"sweep/{axis}/{policy}/{value_text(value)}_crossed.csv"


def sweep_logs(scenario: Scenario, axis: str, group: str) -> list[str]:
    """List the logs of a group of policies along a sweep."""
    return [
        sweep_log(axis, policy, value, seed)
        for policy in group_policies(scenario, swept_policies(scenario, axis), group)
        for value in swept_values(scenario, axis)
        for seed in scenario.sweeps.seeds
    ]


def sweep_outputs(scenario: Scenario, axis: str, group: str) -> list[str]:
    """List all files that a sweep of a group of policies writes."""
    return [*sweep_logs(scenario, axis, group), *sweep_crosses(scenario, axis, group)]


def sweep_crosses(scenario: Scenario, axis: str, group: str) -> list[str]:
    """List the measures of a group along a sweep where it is not logged."""
    return [
        sweep_crossed(axis, policy, value)
        for policy in group_policies(scenario, swept_policies(scenario, axis), group)
        for value in swept_values(scenario, axis)
        if is_crossed(scenario, policy)
    ]


def cell_log(cell: Cell, policy: str, seed: int) -> str:
    """Log of a policy in a cell of another size."""
    return f"generalise/{cell_text(cell)}/{policy}/seed{seed}.mcap"


def cell_crossed(cell: Cell, policy: str) -> str:
    """Measures of a learner's policies in a cell of another size where they are not logged."""
    return f"generalise/{cell_text(cell)}/{policy}/crossed.csv"


def cell_logs(scenario: Scenario, group: str) -> list[str]:
    """List the logs of a group of policies in cells of other sizes."""
    return [
        cell_log(cell, policy, seed)
        for cell in scenario.generalise.cells
        for policy in group_policies(scenario, scenario.generalise.policies, group)
        for seed in scenario.generalise.seeds
    ]


def cell_outputs(scenario: Scenario, group: str) -> list[str]:
    """List all files that a group of policies writes in cells of other sizes."""
    return [*cell_logs(scenario, group), *cell_crosses(scenario, group)]


def cell_crosses(scenario: Scenario, group: str) -> list[str]:
    """List the measures of a group in cells of other sizes where it is not logged."""
    return [
        cell_crossed(cell, policy)
        for cell in scenario.generalise.cells
        for policy in group_policies(scenario, scenario.generalise.policies, group)
        if is_crossed(scenario, policy)
    ]


def gain_study_log(method: str, gain: str, seed: int) -> str:
    """Log of the robots of the gain study under one method and gain."""
    return f"gain_study/{method}_{gain}_seed{seed}.mcap"


def gain_study_logs(scenario: Scenario) -> list[str]:
    """List the logs of the gain study; methods on one plant share those of the nominal gain."""
    return [
        gain_study_log(method, gain, seed)
        for method in scenario.gain_study.methods
        for gain in STUDY_GAINS
        if gain == "adjusted" or method == baseline_method(scenario, method)
        for seed in scenario.gain_study.seeds
    ]


def study_gain_files(scenario: Scenario) -> list[str]:
    """List the gain schedules of the gain study."""
    methods = scenario.gain_study.methods
    variants = [study_scenario(scenario, method, "adjusted") for method in methods]
    return [gain_file(design_of(scenario, variant)) for variant in variants]


def gain_sweep_log(axis: str, value: str, gain: str, seed: int) -> str:
    """Log of the robots at one point of a sweep of the gain study."""
    return f"gain_study/{axis}/{value}_{gain}_seed{seed}.mcap"


def gain_sweep_logs(scenario: Scenario, axis: str) -> list[str]:
    """List the logs of a sweep of the gain study."""
    return [
        gain_sweep_log(axis, point.value, gain, seed)
        for point in gain_points(scenario, axis)
        for gain in STUDY_GAINS
        for seed in scenario.gain_study.seeds
    ]


def gain_sweep_files(scenario: Scenario, axis: str) -> list[str]:
    """List the gain schedules that a sweep of the gain study needs, each once."""
    designs = (design_of(scenario, point.scenario) for point in gain_points(scenario, axis))
    return list(dict.fromkeys(gain_file(design) for design in designs))


def stability_gain_files(scenario: Scenario) -> list[str]:
    """List the gain schedules whose stability regions are computed."""
    weights = scenario.gain_study.weight
    return [gain_file(design_of(scenario, weighted_scenario(scenario, q))) for q in weights]


def claim_logs(scenario: Scenario) -> list[str]:
    """List the logs that the claims read besides the table of all runs."""
    return [*all_training_logs(scenario), *gain_study_logs(scenario)]


def all_logs(scenario: Scenario) -> list[str]:
    """List every log of a study."""
    names = claim_logs(scenario)
    for axis in GAIN_SWEEPS:
        names += gain_sweep_logs(scenario, axis)
    for group in policy_groups(scenario):
        names += measured_logs(scenario, group)
    return names
