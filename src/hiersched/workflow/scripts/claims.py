"""Put the claims of a study together."""

from hiersched.experiments.job import job
from hiersched.study.claims.report import join_claims

if __name__ == "__main__":
    scenario, results, given = job(__doc__, "names")
    join_claims(scenario, results, given.names.split(","))
