"""Files that are there in full or not at all."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd


def refuse_existing(
    *paths: str | os.PathLike[str],
    overwrite: bool = False,
    source: str | os.PathLike[str] | None = None,
) -> None:
    """Raise FileExistsError if a file exists already, unless it is to be overwritten.

    The file that is read to write them, `source`, is never overwritten.
    """
    for path in paths:
        if not os.path.exists(path):
            continue
        if source is not None and os.path.exists(source) and os.path.samefile(source, path):
            raise FileExistsError(f"{path}: is the file to be read, which nothing replaces")
        if not overwrite:
            raise FileExistsError(f"{path}: exists; --overwrite replaces it")


def write_bytes(path: Path, data: bytes) -> Path:
    """Write a file under another name first, and rename it when it is on the disk; return its path.

    Its folder is created.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    with open(part, "wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(part, path)
    return path


def csv_text(table: pd.DataFrame) -> str:
    """Return a table as CSV: numbers read back to the same bits, an empty cell is no number."""
    text: str = table.to_csv(index=False, lineterminator="\n")
    return text


def write_parquet(path: Path, table: pd.DataFrame) -> Path:
    """Write a table as Parquet, in full or not at all; return its path."""
    data: bytes = table.to_parquet(index=False)
    return write_bytes(path, data)
