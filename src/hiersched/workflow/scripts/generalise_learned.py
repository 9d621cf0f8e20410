"""Run the policies of a learner in cells of other sizes."""

import argparse
from pathlib import Path

from hiersched.runs import paths
from hiersched.runs.generalise import generalise
from hiersched.runs.learned import learned_policies
from hiersched.scenario import load_scenario
from hiersched.study.metrics import measured_row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", type=Path, required=True)
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--learner", required=True)
    args = parser.parse_args()
    scenario = load_scenario(args.scenario)
    files = [args.results / name for name in paths.policy_files(scenario, args.learner)]
    generalise(scenario, args.results, args.learner, learned_policies(files), measured_row)


if __name__ == "__main__":
    main()
