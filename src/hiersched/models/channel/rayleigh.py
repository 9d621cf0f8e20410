"""Independent Rayleigh fading of every user, PRB and slot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.core.parameters import Note, Positive
from hiersched.core.randomness import draw_exponentials
from hiersched.models.model import FADING, Model, Setup
from hiersched.models.seams import DRAW_FADING


class RayleighWords(NamedTuple):
    """Mean squared amplitude 2 s^2, and words of the generator (4, B)."""

    mean_power: np.float32
    words: NDArray[np.uint32]


@FADING.model
@dataclass(frozen=True, kw_only=True)
class Rayleigh(Model):
    """Amplitudes of scale s."""

    model: Annotated[
        Literal["rayleigh"], Note("model", "paper", "rayleigh (every slot, user and PRB anew)")
    ] = "rayleigh"
    scale: Annotated[Positive, Note("1", "paper", "s of the Rayleigh amplitude, E[h^2] = 2 s^2")]

    def words(self, setup: Setup) -> RayleighWords:
        """As in `Model`."""
        size = setup.scenario.num_users * setup.scenario.radio.num_prb
        return RayleighWords(
            mean_power=np.float32(2.0 * self.scale**2),
            words=np.zeros((4, (size + 3) // 4), np.uint32),
        )


@DRAW_FADING.kernel(RayleighWords)
def draw_rayleigh(me: RayleighWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Draw the coming slot's squared amplitudes."""
    power = state.fading_power[env].reshape(-1)
    draw_exponentials(state.key[env], state.slot[env], me.mean_power, me.words, power)
