"""Train the agents of all seeds of a learner."""

from pathlib import Path

from hiersched.experiments.dependencies import training_sha256
from hiersched.experiments.fingerprint import code_fingerprint
from hiersched.experiments.job import job
from hiersched.experiments.train import train_and_log

if __name__ == "__main__":
    scenario, results, given = job(__doc__, "learner")
    code = training_sha256(scenario, given.learner, code_fingerprint(Path(__file__)))
    train_and_log(scenario, given.learner, results, code)
