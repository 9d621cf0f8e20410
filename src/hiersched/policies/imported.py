"""Policies that a scenario names by the function that decides."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from hiersched.core.parameters import STRICT, OwnKeys
from hiersched.policies.index_rules import CLASSICAL


def _compiled_rule(name: str) -> str:
    if name not in CLASSICAL:
        raise PydanticCustomError(
            "unknown_rule", "must be one of {known}", {"known": ", ".join(CLASSICAL)}
        )
    return name


@dataclass(frozen=True, kw_only=True)
class ImportedPolicy:
    """A policy from a function: ``import: "module:function"``, and what it is given.

    Attributes
    ----------
    source
        Key `import`: where the function is.
    rule
        The scheduler whose utility its weights multiply.
    parameters
        Keyword arguments.
    """

    __pydantic_config__ = STRICT
    source: Annotated[
        str,
        Field(
            alias="import",
            pattern=r"^[A-Za-z_][A-Za-z0-9_]*(\.[A-Za-z_][A-Za-z0-9_]*)*:[A-Za-z_][A-Za-z0-9_]*$",
        ),
    ]
    rule: Annotated[str, AfterValidator(_compiled_rule)] = "pf"
    parameters: OwnKeys = field(default_factory=dict, hash=False)
