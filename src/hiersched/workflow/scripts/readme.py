"""Write the verdicts of a study into the README, between its two marks."""

import argparse
from pathlib import Path

from hiersched.experiments import files
from hiersched.study.claims.report import insert_table

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--readme", type=Path, default=Path("README.md"))
    given = parser.parse_args()
    claims = (given.results / files.CLAIMS[0]).read_text(encoding="utf-8")
    text = insert_table(given.readme.read_text(encoding="utf-8"), claims)
    given.readme.write_text(text, encoding="utf-8")
