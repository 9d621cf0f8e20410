"""Measure every run of a group of policies, each from its log."""

from hiersched.experiments.job import job
from hiersched.study.measure import measure

if __name__ == "__main__":
    scenario, results, given = job(__doc__, "group")
    measure(scenario, results, given.group)
