"""Files of reference points that nobody would write: each is refused in one message, or driven."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

SCENARIO = """
extends: smoke
robot: {reference: file, reference_file: track.csv, reference_repeat: true}
"""
CELLS = (
    *("", " ", "x", "nan", "inf", "-inf", "1e308", "1e-320", "-0", "0x10", "1_0", "\u0661", "1,5"),
    *('"', '"1"', "'", "=1+1", "\x00", "\x1b[31m", "1e9", "-1e9", "1" * 400, "t", "None", "true"),
)


def circle(rng: random.Random) -> list[list[float]]:
    """Rows that a robot can drive: a part of a circle at 1 m/s."""
    radius, step = rng.choice((2.0, 5.0, -3.0)), 0.1
    angles = [step * i / radius for i in range(rng.randrange(2, 60))]
    rows = [(radius * math.sin(a), radius * (1.0 - math.cos(a)), a) for a in angles]
    return [[step * i, *row] for i, row in enumerate(rows)]


def mutants(count: int) -> Iterator[bytes]:
    """The same each time: other cells, rows, separators, encodings, bytes; some are left right."""
    rng = random.Random(200)
    for _ in range(count):
        cells = [[f"{value:.6g}" for value in row] for row in circle(rng)]
        cells.insert(0, ["t", "x", "y", "theta"])
        for _ in range(rng.choice((0, 0, 1, 1, 2, 4))):
            row = rng.choice(cells)
            what = rng.choice((*["cell"] * 3, *["scale"] * 2, "more", "less", "twice", "swap"))
            if what == "cell" and row:
                row[rng.randrange(len(row))] = rng.choice(CELLS)
            elif what == "scale" and row:
                place = rng.randrange(len(row))
                row[place] = f"{rng.choice((-1, 10, 1e6, 1e-6, 1e12))}"
            elif what == "more":
                row.append(rng.choice(CELLS))
            elif what == "less" and row:
                row.pop()
            elif what == "twice":
                cells.insert(rng.randrange(len(cells)), list(row))
            else:
                rng.shuffle(cells)
        separator = rng.choice((*[","] * 12, ";", "\t"))
        lines = [separator.join(row) for row in cells]
        data = rng.choice(("\n", "\r\n", "\r")).join(lines)
        raw = bytearray(data.encode(rng.choice((*["utf-8"] * 8, *["utf-8-sig"] * 2, "utf-16"))))
        for _ in range(rng.choice((*[0] * 8, 1, 5))):
            raw[rng.randrange(len(raw))] = rng.randrange(256)
        yield bytes(raw[: rng.choice((*[len(raw)] * 10, len(raw) // 2, 0))])


@pytest.mark.parametrize("count", [15, pytest.param(200, marks=pytest.mark.nightly)])
def test_a_mutated_reference_is_refused_or_driven(
    tmp_path: Path, refused_or_run: Callable[..., int], count: int
) -> None:
    paths = []
    for number, data in enumerate(mutants(count)):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "track.csv").write_bytes(data)
        paths.append(folder / "mine.yaml")
        paths[-1].write_text(SCENARIO)
    assert count // 20 < refused_or_run(paths) < count - count // 20
