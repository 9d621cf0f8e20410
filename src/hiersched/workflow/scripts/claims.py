"""Judge the paper's claims from the tables and logs of a study."""

import argparse
from pathlib import Path

from hiersched.scenario import load_scenario
from hiersched.study.claims_report import write_claims


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", type=Path, required=True)
    parser.add_argument("--results", type=Path, required=True)
    args = parser.parse_args()
    write_claims(args.results, load_scenario(args.scenario))


if __name__ == "__main__":
    main()
