"""Rayleigh fading, drawn anew for every slot, user and PRB: |h|^2 = 2 s^2 E, E exponential."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from hiersched.core.parameters import Note, Positive
from hiersched.models.model import FADING, Model


@FADING.model
@dataclass(frozen=True, kw_only=True)
class Rayleigh(Model):
    """Amplitudes of scale s."""

    model: Annotated[
        Literal["rayleigh"], Note("model", "paper", "rayleigh (every slot, user and PRB anew)")
    ] = "rayleigh"
    scale: Annotated[Positive, Note("1", "paper", "s of the Rayleigh amplitude, E[h^2] = 2 s^2")]
