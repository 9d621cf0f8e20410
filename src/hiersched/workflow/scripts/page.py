"""Write the page of a study: everything that it shows in one file."""

from hiersched.experiments.job import job
from hiersched.study.page import write_study_page

if __name__ == "__main__":
    scenario, results, given = job(__doc__, "jobs")
    write_study_page(scenario, results, given.jobs.split(","))
