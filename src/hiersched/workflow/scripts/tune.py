"""Choose the knobs of the families of a cell."""

from hiersched.experiments.job import job
from hiersched.experiments.tune import tune_cell
from hiersched.study.task_metrics import task_row

if __name__ == "__main__":
    scenario, results, given = job(__doc__, "cell")
    tune_cell(scenario, results, given.cell, task_row)
