"""Run the robots under forced delays along one axis of the gain study."""

import argparse
from pathlib import Path

from hiersched.runs.gain_points import GAIN_SWEEPS
from hiersched.runs.gain_study import gain_sweep
from hiersched.scenario import load_scenario


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", type=Path, required=True)
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--axis", choices=list(GAIN_SWEEPS), required=True)
    args = parser.parse_args()
    gain_sweep(load_scenario(args.scenario), args.results, args.axis)


if __name__ == "__main__":
    main()
