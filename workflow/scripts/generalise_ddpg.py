"""Run the learned policies in cells of other sizes."""

import argparse
from pathlib import Path

from hiersched.runs import paths
from hiersched.runs.generalise import generalise
from hiersched.runs.learned import LearnedRunner
from hiersched.runs.variants import LEARNED_GROUP
from hiersched.scenario import load_scenario


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", type=Path, required=True)
    parser.add_argument("--results", type=Path, required=True)
    args = parser.parse_args()
    scenario = load_scenario(args.scenario)
    runner = LearnedRunner([args.results / name for name in paths.policy_files(scenario)])
    generalise(scenario, args.results, LEARNED_GROUP, runner)


if __name__ == "__main__":
    main()
