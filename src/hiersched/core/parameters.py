"""What parameters of a scenario are made of: ranges, and how strictly values are read."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, TypeVar

from pydantic import ConfigDict, Field, TypeAdapter

STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
"""Of every section of a scenario: no unknown key, no conversion, no infinity."""

NonEmpty = Field(min_length=1)
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(gt=0, lt=1)]
Count = Annotated[int, Field(ge=1)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]
Matrix = Annotated[tuple[Annotated[tuple[float, ...], NonEmpty], ...], NonEmpty]

Scalar = bool | int | float | str | None
OwnKeys = Mapping[str, Scalar | tuple[Scalar, ...] | tuple[tuple[Scalar, ...], ...]]
"""Keys that a plug-in reads: numbers, text, lists of them, matrices."""

T = TypeVar("T")


@dataclass(frozen=True)
class Note:
    """What a key means: ``Annotated[Positive, Note("m", "paper", "radius of the cell")]``."""

    unit: str  # such as "m", or "1"
    origin: str  # "paper" or "assumed"
    meaning: str  # half a sentence


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    if not hasattr(kind, "__pydantic_config__"):
        kind.__pydantic_config__ = STRICT
    return TypeAdapter(kind)


def read_strictly(kind: type[T], values: Mapping[str, Any]) -> T:
    """Make a dataclass of plain values, as they come from YAML: lists become tuples.

    A dataclass without a configuration of its own is read as strictly as a section. An unknown or
    missing key, a wrong type, or a value out of range raises pydantic.ValidationError.
    """
    hashable: Any = kind
    result: T = _adapter(hashable).validate_json(json.dumps(values), strict=True)
    return result


def no_multiple(key: str, value: float, unit_key: str, unit: float) -> list[str]:
    """Say that the value of a key is no whole number of another's, one or more; else nothing."""
    count = value / unit
    if round(count) >= 1 and abs(count - round(count)) < 1e-9 * count:
        return []
    return [f"{key} = {value}: must be a multiple of {unit_key} = {unit}"]
