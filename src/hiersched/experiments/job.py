"""Arguments of the scripts that the workflow runs."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from types import TracebackType
from typing import Any

from hiersched.core.extras import MissingExtraError
from hiersched.core.faults import InputError, printable
from hiersched.experiments.turns import join_run
from hiersched.scenario import Scenario, load_scenario


def job(description: str | None, *options: str) -> tuple[Scenario, Path, Any]:
    """Read the command line of a job, whose script takes `options` and what every one does.

    Returns the scenario, the folder of its results, and the values of the options as attributes.
    """
    parser = argparse.ArgumentParser(description=description)
    for name in ("scenario", "results", *options):
        parser.add_argument(f"--{name}", required=True)
    given = parser.parse_args()
    sys.excepthook = _report
    join_run(Path(".snakemake"))
    return load_scenario(given.scenario), Path(given.results), given


def _report(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Say what a user can mend in one message; show where anything else comes from."""
    if isinstance(error, (InputError, MissingExtraError)):
        print(f"error: {printable(str(error))}", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)
