"""Run the classical schedulers in cells of other sizes."""

import argparse
from pathlib import Path

from hiersched.runs.generalise import generalise
from hiersched.runs.policies import untrained_policies
from hiersched.runs.variants import CLASSICAL_GROUP
from hiersched.scenario import load_scenario


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", type=Path, required=True)
    parser.add_argument("--results", type=Path, required=True)
    args = parser.parse_args()
    generalise(load_scenario(args.scenario), args.results, CLASSICAL_GROUP, untrained_policies)


if __name__ == "__main__":
    main()
