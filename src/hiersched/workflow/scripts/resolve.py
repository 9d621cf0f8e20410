"""Write the resolved scenario: defaults and overlay in one file."""

import argparse
import os
from pathlib import Path

from hiersched.runs import paths
from hiersched.scenario import load_scenario, scenario_to_yaml


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", type=Path, required=True)
    parser.add_argument("--results", type=Path, required=True)
    args = parser.parse_args()
    output = args.results / paths.SCENARIO
    part = output.with_name(output.name + ".part")
    part.write_text(scenario_to_yaml(load_scenario(args.scenario)), encoding="utf-8")
    os.replace(part, output)


if __name__ == "__main__":
    main()
