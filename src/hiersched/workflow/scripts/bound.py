"""Compute the exact optima of sampled slots of the evaluation."""

from hiersched.experiments import files
from hiersched.experiments.bound import compute_bound
from hiersched.experiments.job import job

if __name__ == "__main__":
    scenario, results, _ = job(__doc__)
    compute_bound(scenario, results, results / files.BOUND)
