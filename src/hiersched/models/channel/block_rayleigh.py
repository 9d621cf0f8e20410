"""Rayleigh fading that stands for a coherence time, then is drawn anew: block fading.

Each user's blocks begin at a phase of its own, so that they do not all change in the same slot.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np

from hiersched.core.numerics import ln_f32
from hiersched.core.parameters import Note, Positive, no_multiple
from hiersched.core.randomness import STREAM_FADING, philox4x32, unit_f32
from hiersched.models.model import FADING, Model, Setup
from hiersched.models.seams import DRAW_FADING

if TYPE_CHECKING:
    from hiersched.scenario.schema import Scenario

_PHASE, _BLOCK = np.uint32(1), np.uint32(2)
"""Second word of the generator's counter; `rayleigh` has 0 there."""


class BlockWords(NamedTuple):
    """Mean squared amplitude 2 s^2, slots of a block, coefficients of a user (1, or one a PRB)."""

    mean_power: np.float32
    block_slots: int
    is_flat: bool


@FADING.model
@dataclass(frozen=True, kw_only=True)
class BlockRayleigh(Model):
    """Amplitudes of scale s that stand for `coherence_s`."""

    model: Annotated[
        Literal["block_rayleigh"],
        Note("model", "assumed", "block_rayleigh (stands for a coherence time)"),
    ] = "block_rayleigh"
    scale: Annotated[
        Positive, Note("1", "assumed", "s of the Rayleigh amplitude, E[h^2] = 2 s^2")
    ] = 1.0
    coherence_s: Annotated[
        Positive, Note("s", "assumed", "length of a block, a multiple of the slot")
    ] = 0.05
    flat: Annotated[bool, Note("flag", "assumed", "whether all PRBs of a user fade together")] = (
        True
    )

    def faults(self, scenario: Scenario) -> list[str]:
        """As in `Model`: a block is a whole number of slots."""
        unit = "radio.slot_s", scenario.radio.slot_s
        return no_multiple("radio.fading.coherence_s", self.coherence_s, *unit)

    def words(self, setup: Setup) -> BlockWords:
        """As in `Model`."""
        slot_s = setup.scenario.radio.slot_s
        return BlockWords(
            np.float32(2.0 * self.scale**2), round(self.coherence_s / slot_s), self.flat
        )


@DRAW_FADING.kernel(BlockWords)
def draw_blocks(me: BlockWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Write the coming slot's squared amplitudes."""
    key, now = state.key[env], state.slot[env]
    low, high = np.uint32(key), np.uint32(key >> np.uint64(32))
    power = state.fading_power[env]
    num_prb = power.shape[1]
    for user in range(power.shape[0]):
        word, _, _, _ = philox4x32(np.uint32(user), _PHASE, np.uint32(0), STREAM_FADING, low, high)
        block = np.uint32((now + np.int64(word) % me.block_slots) // me.block_slots)
        for k in range(1 if me.is_flat else num_prb):
            index = np.uint32(user * num_prb + k)
            word, _, _, _ = philox4x32(index, _BLOCK, block, STREAM_FADING, low, high)
            power[user, k] = -ln_f32(unit_f32(word)) * me.mean_power
        if me.is_flat:
            for k in range(1, num_prb):
                power[user, k] = power[user, 0]
