"""`hiersched table`: one table of many studies."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hiersched.cli.options import add_overwrite
from hiersched.core.faults import InputError, blaming_input
from hiersched.core.files import csv_text, refuse_existing, write_bytes, write_parquet

if TYPE_CHECKING:
    import pandas as pd

    from hiersched.study.across import Across

LOST = 3
READ = ("urllc_late_share", "tracking_error_cm", "urllc_rate_mbps", "embb_rate_mbps")
"""Measures that are shown to people unless they ask for others, where a table has them."""
SUFFIXES = (".csv", ".md", ".parquet")


def add_commands(commands: Any) -> None:
    """Add the command to the parser."""
    text = "put the tables of many finished studies into one, beside the keys in which they differ"
    table = commands.add_parser("table", help=text, description=text)
    folders = "of the results of studies: results/*"
    table.add_argument("folders", metavar="FOLDER", nargs="+", help=folders)
    text = "which of the studies' tables (policies: a row a policy)"
    table.add_argument("--table", metavar="NAME", default="policies", help=text)
    for name, text in (
        ("policy", "again for more; all"),
        ("measure", "again for more, with intervals; four on the screen and in Markdown, else all"),
        ("key", "of the scenarios that becomes a column, again for more; all that differ"),
    ):
        table.add_argument(
            f"--{name}", metavar=name.upper(), action="append", default=[], help=text
        )
    text = "a column a claim, with its verdict"
    table.add_argument("--verdicts", action="store_true", help=text)
    text = f"write the table instead, by the ending: {', '.join(SUFFIXES)}"
    table.add_argument("--out", metavar="FILE", help=text)
    add_overwrite(table)
    table.set_defaults(command=_table)


def _table(parsed: argparse.Namespace) -> int:
    from hiersched.study.across import table_across

    out = None if parsed.out is None else Path(parsed.out)
    if out is not None:
        if out.suffix not in SUFFIXES:
            raise InputError(f"--out {out}: must end with {', '.join(SUFFIXES)}")
        with blaming_input(FileExistsError):
            refuse_existing(out, overwrite=parsed.overwrite)
    across = table_across(
        parsed.folders,
        parsed.table,
        policies=parsed.policy,
        measures=parsed.measure,
        keys=parsed.key,
        verdicts=parsed.verdicts,
    )
    _show(across, out, all_measures=bool(parsed.measure))
    for what, told in (("left out", across.left_out), ("doubtful", across.remarks)):
        if told:
            print(f"{what}: {len(told)} of {len(parsed.folders)} folders", file=sys.stderr)
            for folder, why in told.items():
                print(f"  {folder}: {why}", file=sys.stderr)
    return LOST if across.left_out else 0


def _show(across: Across, out: Path | None, *, all_measures: bool) -> None:
    """Print or write the table."""
    from hiersched.study.tables.text import aligned_text, markdown_text

    table = across.table
    read = table if all_measures else _to_read(table)
    count = f"{len(table)} rows of {across.studies} studies"
    if out is None:
        print(aligned_text(read), end="")
        return
    if out.suffix == ".parquet":
        write_parquet(out, table)
    elif out.suffix == ".csv":
        write_bytes(out, csv_text(table).encode())
    else:
        write_bytes(out, markdown_text(read, "Studies", f"{count}.").encode())
    print(f"{out}: {count}")


def _to_read(table: pd.DataFrame) -> pd.DataFrame:
    """Return the table with few measures: those of `READ`, where it has them."""
    from hiersched.study.across import with_measures

    found = [name for name in READ if name in table]
    return with_measures(table, found) if found else table
