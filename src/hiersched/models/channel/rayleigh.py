"""Independent Rayleigh fading of every user, PRB and slot."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.core.randomness import draw_exponentials
from hiersched.models.model import Model, Setup
from hiersched.models.seams import DRAW_FADING


class RayleighWords(NamedTuple):
    """Mean squared amplitude 2 s^2, and words of the generator (4, B)."""

    mean_power: np.float32
    words: NDArray[np.uint32]


class Rayleigh(Model):
    """Block fading: h^2 = 2 s^2 Exp(1), anew in every slot."""

    scale: float

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
