"""Rates by Shannon's formula: r = B log2(1 + SNR), and all of it arrives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from hiersched.core.parameters import Note
from hiersched.models.model import LINK, Model


@LINK.model
@dataclass(frozen=True, kw_only=True)
class Shannon(Model):
    """Every PRB carries its capacity."""

    model: Annotated[
        Literal["shannon"], Note("model", "paper", "shannon (B log2(1 + SNR), all of it arrives)")
    ] = "shannon"
