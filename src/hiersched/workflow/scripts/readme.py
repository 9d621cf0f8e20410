"""Write the verdicts of a study into the README, between its two marks."""

import argparse
from pathlib import Path

from hiersched.runs import paths
from hiersched.study.claims_report import insert_table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--readme", type=Path, default=Path("README.md"))
    args = parser.parse_args()
    claims = (args.results / paths.CLAIMS[0]).read_text(encoding="utf-8")
    text = insert_table(args.readme.read_text(encoding="utf-8"), claims)
    args.readme.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
