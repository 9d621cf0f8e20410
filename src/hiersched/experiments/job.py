"""Arguments of the scripts that the workflow runs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from hiersched.scenario import Scenario, load_scenario


def job(description: str | None, *options: str) -> tuple[Scenario, Path, Any]:
    """Read the command line of a job, whose script takes `options` and what every one does.

    Returns the scenario, the folder of its results, and the values of the options as attributes.
    """
    parser = argparse.ArgumentParser(description=description)
    for name in ("scenario", "results", *options):
        parser.add_argument(f"--{name}", required=True)
    given = parser.parse_args()
    return load_scenario(given.scenario), Path(given.results), given
