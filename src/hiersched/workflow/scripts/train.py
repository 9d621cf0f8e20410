"""Train the agents of all seeds of a learner."""

import argparse
from pathlib import Path

from hiersched.runs.fingerprint import code_fingerprint
from hiersched.runs.train import train_and_log
from hiersched.scenario import load_scenario


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", type=Path, required=True)
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--learner", required=True)
    args = parser.parse_args()
    code = code_fingerprint(Path(__file__))
    train_and_log(load_scenario(args.scenario), args.learner, args.results, code)


if __name__ == "__main__":
    main()
