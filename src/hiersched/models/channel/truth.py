"""A base station that knows every channel as it is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from hiersched.core.parameters import Note
from hiersched.models.model import REPORT, Model


@REPORT.model
@dataclass(frozen=True, kw_only=True)
class Truth(Model):
    """Reported rates are those of the coming slot."""

    model: Annotated[
        Literal["truth"],
        Note("model", "paper", "truth (the base station knows the rates of the coming slot)"),
    ] = "truth"
