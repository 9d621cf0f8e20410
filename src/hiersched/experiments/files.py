"""Where the files of a study lie, relative to its folder ``results/<scenario>``."""

from __future__ import annotations

from hiersched.experiments.points import Experiment, Point, groups, has_unlogged
from hiersched.scenario import Scenario

SCENARIO = "scenario.yaml"
"""The scenario with every value in place."""
CHECKPOINTS = "checkpoints"
"""Where trainings that have been interrupted go on; empty when they are through."""
STABILITY = "gains/stability.json"
"""Longest delays of the loops of the gain study."""
GROWTH = "measures/growth.parquet"
"""Table of measures: how the loops at every point grow over the delays that they had."""
RUNS = "runs"
"""Runs of every experiment."""
BOUND = "bound/slots.csv"
"""Exact optima of sampled slots, beside the decisions there."""
CLAIMS = ("claims.json", "claims.md", "claims.html")
"""Verdicts on the paper's claims, to compute with and to read."""
PAGE = "report.html"
"""All of it on one page: verdicts, figures, tables that sort, where everything comes from."""


def gain_file(design: str) -> str:
    """Gains for every delay, with their certificates, by their name among `designs`."""
    return f"gains/{design}.json"


def progress_file(learner: str) -> str:
    """Learning curves of a learner."""
    return f"train/{learner}/progress.csv"


def policy_files(scenario: Scenario, learner: str) -> list[str]:
    """Weights of all training seeds of a learner."""
    return [f"train/{learner}/policy_seed{seed}.json" for seed in scenario.learned[learner].seeds]


def training_log(learner: str, seed: int) -> str:
    """Log of the training of one seed."""
    return f"train/{learner}/seed{seed}.mcap"


def checkpoint_log(learner: str, seed: int) -> str:
    """Log of the policies of one seed without noise, at the start and during training."""
    return f"train/{learner}/checkpoints_seed{seed}.mcap"


def learner_logs(scenario: Scenario, learner: str) -> list[str]:
    """List the logs of the training of all seeds of a learner, those without noise among them."""
    kinds = (training_log, checkpoint_log) if logs_training(scenario) else (checkpoint_log,)
    return [log(learner, seed) for log in kinds for seed in scenario.learned[learner].seeds]


def logs_training(scenario: Scenario) -> bool:
    """Whether there are logs of the training itself, besides those without noise."""
    return scenario.log.train_profile != "none"


def runs_folder(experiment: Experiment, point: Point, policy: str) -> str:
    """Folder of the runs of a policy at a point."""
    return "/".join(filter(None, (RUNS, experiment.name, point.value, policy)))


def run_log(experiment: Experiment, point: Point, policy: str, seed: int) -> str:
    """Log of a policy at a point in the world of a seed."""
    return f"{runs_folder(experiment, point, policy)}/seed{seed}.mcap"


def full_log(experiment: Experiment, point: Point, policy: str, seed: int) -> str:
    """Log of the beginning of such a run in full."""
    return f"{runs_folder(experiment, point, policy)}/seed{seed}_full.mcap"


def crossed_file(experiment: Experiment, point: Point, policy: str) -> str:
    """Measures of runs of a policy that were taken as they ran: of those without a log, or all."""
    return f"{runs_folder(experiment, point, policy)}/crossed.parquet"


def group_logs(experiment: Experiment, policies: tuple[str, ...]) -> list[str]:
    """List the logs of a group of policies in an experiment, but for those in full."""
    return [
        run_log(experiment, point, policy, seed)
        for point, policy in experiment.runs(policies)
        for seed in experiment.logged_seeds
    ]


def tuning_file(cell: str) -> str:
    """Knobs of the families of a cell of the study of the task, and how they were chosen."""
    return f"tune/{cell}.json"


def group_files(scenario: Scenario, experiment: Experiment, group: str) -> list[str]:
    """List all files that a group of policies writes in an experiment."""
    policies = groups(scenario, experiment)[group]
    names = group_logs(experiment, policies)
    for point, policy in experiment.runs(policies):
        full = experiment.seeds[: experiment.full_logs]
        names += [full_log(experiment, point, policy, seed) for seed in full]
        if has_unlogged(scenario, experiment, policy):
            names.append(crossed_file(experiment, point, policy))
    return names
