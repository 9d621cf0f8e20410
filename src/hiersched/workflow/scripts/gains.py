"""Design one gain schedule."""

import argparse
import logging
from pathlib import Path

from hiersched.runs import paths
from hiersched.runs.gains import design_gains
from hiersched.scenario import load_scenario


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", type=Path, required=True)
    parser.add_argument(
        "--design", required=True, help="schedule, or schedule_<h>, _<method> or _q<weight>"
    )
    parser.add_argument("--results", type=Path, required=True)
    args = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    output = args.results / paths.gain_file(args.design)
    schedule = design_gains(load_scenario(args.scenario), args.design, output)
    for delay, (status, deviation) in enumerate(
        zip(schedule.status, schedule.deviation, strict=True)
    ):
        print(f"T = {delay}: {status}, distance from the nominal gain {deviation:.4g}")


if __name__ == "__main__":
    main()
