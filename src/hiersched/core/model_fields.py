"""Numbers that models add to the record of a slot: their names, and where they lie among them."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class ModelField:
    """A field of a model: one number a user, or a robot for a plant.

    Attributes
    ----------
    name, unit
        Such as ``radio.fading/coherence`` and ``1``.
    start, count
        Its numbers are those from `start` to before `start + count`.
    """

    name: str
    unit: str
    start: int
    count: int


def fields_to_text(fields: Iterable[ModelField]) -> str:
    """Write fields as JSON, as in the metadata of logs."""
    return json.dumps([asdict(field) for field in fields], separators=(",", ":"))


def fields_from_text(text: str, num_values: int) -> tuple[ModelField, ...]:
    """Read what `fields_to_text` wrote.

    Raises
    ------
    ValueError
        If it is anything else, or the fields are not, one behind the other, those of `num_values`
        numbers.
    """
    found = []
    start = 0
    try:
        for entry in json.loads(text):
            field = ModelField(**entry)
            if field.start != start or field.count < 1:
                raise ValueError(f"{field.name} has {field.count} numbers from {field.start} on")
            start += field.count
            found.append(field)
    except TypeError as error:
        raise ValueError(f"{text}: no fields of models") from error
    if start != num_values or len({field.name for field in found}) != len(found):
        raise ValueError(f"{text}: not fields of {num_values} numbers")
    return tuple(found)


def element_name(fields: Iterable[ModelField], index: int) -> str:
    """Name a number: ``radio.fading/coherence[3]``."""
    for field in fields:
        if field.start <= index < field.start + field.count:
            return f"{field.name}[{index - field.start}]"
    raise IndexError(f"{index}: no number of a model")
