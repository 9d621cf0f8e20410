"""Train the agents of all seeds."""

import argparse
from pathlib import Path

from hiersched.runs.fingerprint import code_fingerprint
from hiersched.runs.train import train_and_log
from hiersched.scenario import load_scenario


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", type=Path, required=True)
    parser.add_argument("--results", type=Path, required=True)
    args = parser.parse_args()
    train_and_log(load_scenario(args.scenario), args.results, code_fingerprint(Path(__file__)))


if __name__ == "__main__":
    main()
