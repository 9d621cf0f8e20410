"""Write the resolved scenario: defaults and overlay in one file."""

import argparse
import os
from pathlib import Path

from hiersched.scenario import load_scenario, scenario_to_yaml


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", required=True, help="name or path")
    parser.add_argument("--output", type=Path, required=True)
    args = parser.parse_args()
    part = args.output.with_name(args.output.name + ".part")
    part.write_text(scenario_to_yaml(load_scenario(args.scenario)), encoding="utf-8")
    os.replace(part, args.output)


if __name__ == "__main__":
    main()
