"""Find the longest delays of the loops of the gain study."""

from hiersched.experiments.job import job
from hiersched.experiments.stability import write_stability

if __name__ == "__main__":
    scenario, results, _ = job(__doc__)
    write_stability(scenario, results)
