"""Run the policies of an experiment that need no training, or the loops of the gain study."""

from hiersched.experiments.job import job
from hiersched.experiments.run import run_experiment
from hiersched.experiments.worlds import untrained_policies

if __name__ == "__main__":
    scenario, results, given = job(__doc__, "experiment", "group")
    source = untrained_policies
    run_experiment(scenario, results, given.experiment, given.group, source)
