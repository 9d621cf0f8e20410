"""Find the longest delay of every loop of the gain study."""

import argparse
from pathlib import Path

from hiersched.runs.stability import write_stability
from hiersched.scenario import load_scenario


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", type=Path, required=True)
    parser.add_argument("--results", type=Path, required=True)
    args = parser.parse_args()
    write_stability(load_scenario(args.scenario), args.results)


if __name__ == "__main__":
    main()
