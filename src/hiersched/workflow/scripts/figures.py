"""Draw the figures of a study from its logs."""

import argparse
from pathlib import Path

from hiersched.scenario import load_scenario
from hiersched.study.figures import draw_figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", type=Path, required=True)
    parser.add_argument("--results", type=Path, required=True)
    args = parser.parse_args()
    draw_figures(args.results, load_scenario(args.scenario))


if __name__ == "__main__":
    main()
