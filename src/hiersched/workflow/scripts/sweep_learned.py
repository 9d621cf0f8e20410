"""Run the policies of a learner along one axis."""

import argparse
from pathlib import Path

from hiersched.runs import paths
from hiersched.runs.learned import learned_policies
from hiersched.runs.sweep import sweep
from hiersched.runs.variants import SWEPT_KEYS
from hiersched.scenario import load_scenario
from hiersched.study.metrics import measured_row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", type=Path, required=True)
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--learner", required=True)
    parser.add_argument("--axis", choices=list(SWEPT_KEYS), required=True)
    args = parser.parse_args()
    scenario = load_scenario(args.scenario)
    files = [args.results / name for name in paths.policy_files(scenario, args.learner)]
    sweep(scenario, args.results, args.axis, args.learner, learned_policies(files), measured_row)


if __name__ == "__main__":
    main()
