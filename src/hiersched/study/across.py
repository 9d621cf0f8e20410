"""One table of many studies: the tables that they wrote, beside the keys in which they differ."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hiersched.core.extras import naming_extras
from hiersched.core.faults import InputError
from hiersched.experiments import files
from hiersched.scenario import ScenarioError
from hiersched.scenario.fault_text import meant
from hiersched.scenario.load import resolved_values

with naming_extras():
    import pandas as pd

    from hiersched.study.tables.text import merged_columns

POLICIES = "policies"
"""The table of a study with a row a policy."""
_NAME = "name"


@dataclass(frozen=True)
class Across:
    """A table of many studies, and what has to be known of it."""

    table: pd.DataFrame
    """A row a study and row of its table. Columns `scenario`, the `folder` where two studies have
    the same name, the keys, verdicts, and those of the studies' tables."""
    keys: list[str]
    """Columns that are keys of the scenarios."""
    studies: int
    """Studies whose rows these are."""
    left_out: dict[str, str]
    """Folder -> why nothing of it is in the table."""
    remarks: dict[str, str]
    """Folder -> what is doubtful about its rows, or what they lack."""


def with_measures(table: pd.DataFrame, measures: Sequence[str]) -> pd.DataFrame:
    """Return what a table says of its rows, and some measures with the ends of their intervals.

    What it says of its rows are the columns before every interval and these measures. InputError
    for a measure that it does not have.
    """
    names = list(table.columns)
    if unknown := [name for name in measures if name not in names]:
        known, _ = merged_columns(table)
        raise InputError(
            f"measure {unknown[0]}: no study has it; there are: {', '.join(known) or 'none'}"
        )
    about = names[: min(map(names.index, {*merged_columns(table)[0], *measures}))]
    ends = [f"{name}{end}" for name in measures for end in ("", "_lo", "_hi")]
    return table[list(dict.fromkeys([*about, *(name for name in ends if name in names)]))]


@dataclass(frozen=True)
class _StudyRows:
    folder: str
    values: dict[str, Any]
    rows: pd.DataFrame
    verdicts: dict[str, str]


def table_across(
    folders: Iterable[str | Path],
    table: str = POLICIES,
    *,
    policies: Sequence[str] = (),
    measures: Sequence[str] = (),
    keys: Sequence[str] = (),
    verdicts: bool = False,
) -> Across:
    """Put the tables of finished studies into one.

    Parameters
    ----------
    folders
        ``results/<scenario>`` of each study, in the order of the rows.
    table
        Name of the table, ``tables/<table>.csv`` of each study: numbers are as they stand there.
    policies, measures
        Rows of these policies, columns of these measures with the ends of their intervals; all
        unless given. Columns that stand before every interval and these measures say what a row is
        about, and stay.
    keys
        Dotted keys of the scenarios that become columns: unless given, all in which the studies
        differ. Lists are written as JSON; empty: none, or a key that the model there does not have.
    verdicts
        Whether each claim has a column with its verdict.

    Raises
    ------
    InputError
        Where no study can be read, or none has a policy, measure or key.
    """
    read: list[_StudyRows] = []
    left_out: dict[str, str] = {}
    remarks: dict[str, str] = {}
    for folder in map(Path, folders):
        try:
            read.append(_read_study(folder, table, verdicts, remarks))
        except (OSError, ValueError, ScenarioError) as error:
            left_out[str(folder)] = _reason(folder, error)
    if not read:
        reasons = "; ".join(f"{name}: {why}" for name, why in left_out.items())
        raise InputError(f"no study to read: {reasons or 'no folder was given'}")
    columns = _key_columns(read, keys)
    joined = pd.concat(_with_keys(read, columns), ignore_index=True)
    joined = joined.assign(**{name: _column(joined[name]) for name in columns})
    if joined.groupby("scenario")["folder"].nunique().max() == 1:
        joined = joined.drop(columns="folder")
    joined = _of_policies(joined, policies)
    return Across(
        table=with_measures(joined, measures) if measures else joined,
        keys=list(columns),
        studies=len(read),
        left_out=left_out,
        remarks=remarks,
    )


def _read_study(folder: Path, table: str, verdicts: bool, remarks: dict[str, str]) -> _StudyRows:
    """Read what a study has written; what is doubtful goes to `remarks`."""
    scenario, path = folder / files.SCENARIO, folder / f"tables/{table}.csv"
    if not folder.is_dir():
        raise ValueError("not a folder")
    if not scenario.is_file():
        raise ValueError(f"no study: it has no {files.SCENARIO}")
    if not path.is_file():
        raise ValueError(f"no tables/{table}.csv: unfinished, or a scenario that does not show it")
    values, added = resolved_values(scenario)
    doubts = []
    if added:
        some = ", ".join(added[:3]) + (", …" if len(added) > 3 else "")
        doubts.append(
            f"{files.SCENARIO} lacks keys of this version, whose defaults stand there: {some}"
        )
    if path.stat().st_mtime < scenario.stat().st_mtime:
        doubts.append(
            f"tables/{table}.csv is older than {files.SCENARIO}, so its numbers may be those of "
            "other values: run the study to its end"
        )
    judged = _read_verdicts(folder) if verdicts else {}
    if verdicts and not judged:
        doubts.append(f"no {files.CLAIMS[0]}: no verdicts")
    if doubts:
        remarks[str(folder)] = "; ".join(doubts)
    return _StudyRows(str(folder), values, _read_csv(path), judged)


def _read_csv(path: Path) -> pd.DataFrame:
    """Read a table of a study; ValueError if it is cut off or none."""
    text = path.read_text(encoding="utf-8")
    if not text.endswith("\n"):
        raise ValueError(f"tables/{path.name} is cut off")
    # A policy may be called None: an empty cell alone is no number.
    rows = pd.read_csv(path, keep_default_na=False, na_values=[""])
    if rows.empty:
        raise ValueError(f"tables/{path.name} has no rows")
    return rows


def _read_verdicts(folder: Path) -> dict[str, str]:
    """Column -> verdict, of the claims of a study; none where it has none."""
    path = folder / files.CLAIMS[0]
    if not path.is_file():
        return {}
    try:
        claims = json.loads(path.read_text(encoding="utf-8"))["claims"]
        return {f"claim{claim['number']}": str(claim["verdict"]) for claim in claims}
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{files.CLAIMS[0]} cannot be read: {error!r:.100}") from error


def _reason(folder: Path, error: Exception) -> str:
    """Return why a folder cannot be read, in one line without its own name."""
    if isinstance(error, OSError):
        return f"{Path(error.filename or folder).name}: {error.strerror}"
    return " ".join(str(error).split()).removeprefix(f"{folder}/")


def _key_columns(read: Sequence[_StudyRows], wanted: Sequence[str]) -> dict[str, list[Any]]:
    """Return keys as columns, a value a study: the wanted ones, or all that differ."""
    known = dict.fromkeys(key for study in read for key in study.values if key != _NAME)
    if unknown := [key for key in wanted if key not in known]:
        raise InputError(f"key {unknown[0]}: no scenario has it{meant(unknown[0], list(known))}")
    columns = {key: [study.values.get(key) for study in read] for key in wanted or known}
    if wanted:
        return columns
    return {key: own for key, own in columns.items() if any(value != own[0] for value in own)}


def _with_keys(read: Sequence[_StudyRows], columns: dict[str, list[Any]]) -> Iterator[pd.DataFrame]:
    """Put what a study is before its rows."""
    claims = _claims(read)
    for number, study in enumerate(read):
        cells = {"scenario": study.values[_NAME], "folder": study.folder}
        cells |= {key: values[number] for key, values in columns.items()}
        cells |= {claim: study.verdicts.get(claim) for claim in claims}
        count = len(study.rows)
        before = pd.DataFrame(
            {name: pd.Series([v] * count, dtype=object) for name, v in cells.items()}
        )
        yield pd.concat([before, study.rows], axis="columns")


def _claims(read: Sequence[_StudyRows]) -> list[str]:
    """List the columns of verdicts, in the order of their numbers."""
    found = {claim for study in read for claim in study.verdicts}
    return sorted(found, key=lambda claim: int(claim.removeprefix("claim")))


def _column(values: pd.Series[Any]) -> pd.Series[Any]:
    """Return values of a key as a column of one kind: truths, numbers or text."""
    given = [value for value in values if value is not None]
    kinds = {type(value) for value in given}
    if kinds <= {bool}:
        return values.astype("boolean")
    if kinds <= {int, float}:
        return values.infer_objects() if len(given) == len(values) else values.astype(float)
    return values.map(
        lambda value: value if value is None or isinstance(value, str) else json.dumps(value)
    )


def _of_policies(table: pd.DataFrame, wanted: Sequence[str]) -> pd.DataFrame:
    if not wanted:
        return table
    known = list(dict.fromkeys(table["policy"])) if "policy" in table else []
    if unknown := [name for name in wanted if name not in known]:
        names = ", ".join(map(str, known)) or "none"
        raise InputError(f"policy {unknown[0]}: no study has it; there are: {names}")
    return table[table["policy"].isin(wanted)].reset_index(drop=True)
