"""Run the classical schedulers along one axis."""

import argparse
from pathlib import Path

from hiersched.runs.policies import untrained_policies
from hiersched.runs.sweep import sweep
from hiersched.runs.variants import CLASSICAL_GROUP, SWEPT_KEYS
from hiersched.scenario import load_scenario


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", type=Path, required=True)
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--axis", choices=list(SWEPT_KEYS), required=True)
    args = parser.parse_args()
    scenario = load_scenario(args.scenario)
    sweep(scenario, args.results, args.axis, CLASSICAL_GROUP, untrained_policies)


if __name__ == "__main__":
    main()
