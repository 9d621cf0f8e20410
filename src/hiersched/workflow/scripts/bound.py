"""Compute the exact optimum of sampled slots of the evaluation."""

import argparse
from pathlib import Path

from hiersched.runs import paths
from hiersched.runs.bound import compute_bound
from hiersched.scenario import load_scenario


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", type=Path, required=True)
    parser.add_argument("--results", type=Path, required=True)
    args = parser.parse_args()
    compute_bound(load_scenario(args.scenario), args.results, args.results / paths.BOUND)


if __name__ == "__main__":
    main()
