"""Design one gain schedule."""

import logging

from hiersched.experiments import files
from hiersched.experiments.gains import design_gains
from hiersched.experiments.job import job

if __name__ == "__main__":
    scenario, results, given = job(__doc__, "design")
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    schedule = design_gains(scenario, given.design, results / files.gain_file(given.design))
    for delay, status in enumerate(schedule.status):
        distance = schedule.deviation[delay]
        print(f"T = {delay}: {status}, distance from the nominal gain {distance:.4g}")
