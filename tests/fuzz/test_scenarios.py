"""Scenarios that nobody would write: each is refused with one message, or it runs."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from hiersched.scenario import load_scenario, scenario_to_dict
from hiersched.scenario.plugins import CONFIG

SHIPPED = ("smoke", "paper", "urban_macro", "linear_plant")
VALUES: tuple[Any, ...] = (
    *(
        None,
        True,
        False,
        "",
        "x",
        "pf",
        "010",
        "1:1",
        "\x1b[31mred\x1b[0m",
        "a\x00b",
        "ddpg",
        "all",
    ),
    *(0, 1, -1, 2, 3, 7, 64, 1000, 10**6, 10**9, 2**31, 2**53 + 1, 2**63, 2**64, 10**30),
    *(0.0, -0.0, 0.5, 1.0, 1.5, 1e-3, 1e-9, 1e-40, 1e-308, 5e-324, 1e9, 1e40, 1e308),
    *(float("nan"), float("inf"), -float("inf"), [], {}, [[]], [0], [1.0, 2.0], [1, 1], ["pf"]),
    *({"model": "none"}, {"model": "x"}, {"x": 1}, {1: 2}, [None], [[1, 2, 3]], "x" * 5000),
)
SNIPPETS = (
    *("&a [*a]", "*b", "!!python/object/apply:os.system ['true']", "!!binary aGk=", "? [a]\n: b\n"),
    *("\t", "---\n", "...\n", "%YAML 1.1\n", "<<: {a: 1}\n", "1:1", "010", "0x1F", "2001-01-01"),
    *(
        "{",
        "]",
        ": ",
        "#",
        "'",
        '"',
        "|",
        "\x00",
        "\x1b[2J",
        "\u202e",
        "\ufeff",
        "é",
        "~",
        "=",
        "!",
    ),
)


def leaves(tree: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of all values of a tree of mappings and lists, the inner nodes too."""
    if path:
        yield path
    items = (
        tree.items()
        if isinstance(tree, dict)
        else enumerate(tree)
        if isinstance(tree, list)
        else ()
    )
    for key, value in items:
        yield from leaves(value, (*path, key))


def holder(tree: Any, path: tuple[Any, ...]) -> Any:
    for key in path[:-1]:
        tree = tree[key]
    return tree


def scaled(value: Any, rng: random.Random) -> Any:
    """Return a number some decades away, anything else as it is."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return rng.choice(VALUES)
    factor = 10.0 ** rng.choice((-40, -9, -3, -2, -1, 1, 2, 3, 6, 9, 40)) * rng.choice((1, 1, -1))
    return type(value)(max(-(10**18), min(10**18, value * factor)))


def mutate_tree(tree: dict[str, Any], rng: random.Random) -> str:
    """Change one to three values or keys, and write the tree."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        path = rng.choice(list(leaves(tree)))
        inner, key = holder(tree, path), path[-1]
        what = rng.choice(
            ("value", "value", "scale", "scale", "scale", "drop", "key", "swap", "more")
        )
        if what == "value":
            inner[key] = rng.choice(VALUES)
        elif what == "scale":
            inner[key] = scaled(inner[key], rng)
        elif what == "drop":
            inner.pop(key)
        elif what == "swap":
            other = rng.choice(list(leaves(tree)))
            inner[key] = yaml.safe_load(yaml.safe_dump(holder(tree, other)[other[-1]]))
        elif what == "more" and isinstance(inner[key], list):
            inner[key] = inner[key] * rng.choice((2, 100, 3000))
        elif isinstance(inner, dict):
            new = rng.choice((f"{key}x", str(key)[:-1], 1, None, "", "model", "\x1b[1m", 1.5, True))
            inner[new] = inner.pop(key)
    return yaml.safe_dump(tree, allow_unicode=bool(rng.getrandbits(1)), sort_keys=False)


def mutate_text(text: str, rng: random.Random) -> bytes:
    """Damage the text: bytes, lines, snippets of YAML."""
    data = bytearray(text.encode())
    for _ in range(rng.choice((1, 1, 2, 5))):
        place = rng.randrange(len(data))
        what = rng.choice(("byte", "cut", "line", "snippet", "snippet", "digit", "digit"))
        if what == "byte":
            data[place] = rng.randrange(256)
        elif what == "cut":
            del data[place : place + rng.randrange(1, 40)]
        elif what == "line":
            lines = bytes(data).split(b"\n")
            lines.insert(rng.randrange(len(lines)), rng.choice(lines))
            data = bytearray(b"\n".join(lines))
        elif what == "digit":
            digits = [i for i, byte in enumerate(data) if 48 <= byte < 58]
            data[rng.choice(digits)] = rng.choice(b"0123456789.-e:_")
        else:
            data[place:place] = rng.choice(SNIPPETS).encode()
    return bytes(data)


def mutants(count: int) -> Iterator[bytes]:
    """Mutated scenarios, the same each time: overlays as shipped and complete ones."""
    rng = random.Random(20261129)
    texts = [
        (CONFIG / "scenarios" / f"{name}.yaml").read_text(encoding="utf-8") for name in SHIPPED
    ]
    whole = [scenario_to_dict(load_scenario(name)) for name in SHIPPED]
    for number in range(count):
        if number % 4 == 0:
            yield mutate_text(rng.choice(texts), rng)
        else:
            tree = rng.choice((yaml.safe_load(rng.choice(texts)), rng.choice(whole)))
            copy = yaml.safe_load(yaml.safe_dump(tree))
            if rng.random() < 0.5:
                copy.pop("name", None)
            yield mutate_tree(copy, rng).encode("utf-8", "surrogatepass")


@pytest.mark.parametrize("count", [10, pytest.param(1000, marks=pytest.mark.nightly)])
def test_a_mutated_scenario_is_refused_or_runs(
    tmp_path: Path, refused_or_run: Callable[..., int], count: int
) -> None:
    paths = []
    for number, data in enumerate(mutants(count)):
        paths.append(tmp_path / f"m{number}.yaml")
        paths[-1].write_bytes(data)
    assert count // 20 < refused_or_run(paths) < count // 2
