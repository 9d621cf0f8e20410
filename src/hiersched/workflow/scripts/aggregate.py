"""Write the tables of a study from its logs."""

import argparse
from pathlib import Path

from hiersched.scenario import load_scenario
from hiersched.study.tables import write_tables


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", type=Path, required=True)
    parser.add_argument("--results", type=Path, required=True)
    args = parser.parse_args()
    write_tables(args.results, load_scenario(args.scenario))


if __name__ == "__main__":
    main()
