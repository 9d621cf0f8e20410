"""Run the robots under forced delays with nominal and adjusted gains."""

import argparse
from pathlib import Path

from hiersched.runs.gain_study import gain_study
from hiersched.scenario import load_scenario


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", type=Path, required=True)
    parser.add_argument("--results", type=Path, required=True)
    args = parser.parse_args()
    gain_study(load_scenario(args.scenario), args.results)


if __name__ == "__main__":
    main()
