"""Run the policies of a cell of the study of the task: families at their knobs, or a learner."""

from hiersched.experiments import files
from hiersched.experiments.job import job
from hiersched.experiments.learned import learned_policies
from hiersched.experiments.run import run_experiment
from hiersched.experiments.tune import tuned_scenario
from hiersched.experiments.worlds import PolicySource, untrained_policies
from hiersched.study.task_metrics import task_row

if __name__ == "__main__":
    scenario, results, given = job(__doc__, "experiment", "group")
    source: PolicySource = untrained_policies
    if given.group in scenario.learned:
        weights = [results / name for name in files.policy_files(scenario, given.group)]
        source = learned_policies(weights)
    run_experiment(
        scenario, results, given.experiment, given.group, source, task_row, tuned_scenario
    )
