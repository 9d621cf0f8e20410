"""Run the learned policies along one axis."""

import argparse
from pathlib import Path

from hiersched.runs import paths
from hiersched.runs.learned import LearnedRunner
from hiersched.runs.sweep import sweep
from hiersched.runs.variants import LEARNED_GROUP, SWEPT_KEYS
from hiersched.scenario import load_scenario


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", type=Path, required=True)
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--axis", choices=list(SWEPT_KEYS), required=True)
    args = parser.parse_args()
    scenario = load_scenario(args.scenario)
    runner = LearnedRunner([args.results / name for name in paths.policy_files(scenario)])
    sweep(scenario, args.results, args.axis, LEARNED_GROUP, runner)


if __name__ == "__main__":
    main()
