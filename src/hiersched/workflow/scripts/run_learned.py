"""Run the policies of a learner in an experiment."""

from hiersched.experiments import files
from hiersched.experiments.job import job
from hiersched.experiments.learned import learned_policies
from hiersched.experiments.run import run_experiment
from hiersched.study.metrics import measured_row

if __name__ == "__main__":
    scenario, results, given = job(__doc__, "experiment", "group")
    weights = [results / name for name in files.policy_files(scenario, given.group)]
    source = learned_policies(weights)
    run_experiment(scenario, results, given.experiment, given.group, source, measured_row)
