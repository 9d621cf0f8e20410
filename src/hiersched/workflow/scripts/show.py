"""Make one table, figure or claim of a study from its measures."""

from hiersched.experiments.job import job
from hiersched.study.show import show

if __name__ == "__main__":
    scenario, results, given = job(__doc__, "kind", "name", "module")
    show(scenario, results, given.kind, given.name, given.module)
