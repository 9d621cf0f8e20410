"""Follow the loops of a study over the delays that they had."""

from hiersched.experiments.job import job
from hiersched.study.growth import write_growth

if __name__ == "__main__":
    scenario, results, _ = job(__doc__)
    write_growth(scenario, results)
