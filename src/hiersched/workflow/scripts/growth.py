"""Follow the loops of a group of policies over the delays that they had."""

from hiersched.experiments.job import job
from hiersched.study.growth import write_growth

if __name__ == "__main__":
    scenario, results, given = job(__doc__, "group")
    write_growth(scenario, results, given.group)
