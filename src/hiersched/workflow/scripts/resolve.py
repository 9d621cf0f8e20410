"""Write the resolved scenario: defaults and overlay in one file."""

from hiersched.core.files import write_bytes
from hiersched.experiments import files
from hiersched.experiments.job import job
from hiersched.scenario import scenario_to_yaml

if __name__ == "__main__":
    scenario, results, _ = job(__doc__)
    write_bytes(results / files.SCENARIO, scenario_to_yaml(scenario).encode())
