"""Measure every run of a group of policies from its log."""

import argparse
from pathlib import Path

from hiersched.scenario import load_scenario
from hiersched.study.collect import write_measures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", type=Path, required=True)
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--group", required=True)
    args = parser.parse_args()
    write_measures(args.results, load_scenario(args.scenario), args.group)


if __name__ == "__main__":
    main()
