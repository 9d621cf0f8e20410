"""Shannon's rate of every resource block, delivered as reported: r = B log2(1 + snr |h|^2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from hiersched.core.numerics import log2_f64
from hiersched.core.parameters import Note
from hiersched.models.model import LINK, Model, Setup
from hiersched.models.seams import DELIVER, RATE_PRBS


class ShannonWords(NamedTuple):
    """Bandwidth of one PRB."""

    prb_bandwidth_mhz: float


@LINK.model
@dataclass(frozen=True, kw_only=True)
class Shannon(Model):
    """Every PRB carries its capacity."""

    model: Annotated[
        Literal["shannon"], Note("model", "paper", "shannon (B log2(1 + SNR), all of it arrives)")
    ] = "shannon"

    def words(self, setup: Setup) -> ShannonWords:
        """As in `Model`."""
        radio = setup.scenario.radio
        return ShannonWords(prb_bandwidth_mhz=radio.bandwidth_hz / radio.num_prb * 1e-6)


@RATE_PRBS.kernel(ShannonWords)
def rate_prbs(me: ShannonWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Rate of every user on every PRB of the coming slot: B log2(1 + snr |h|^2).

    Rounded to float32, so that sums over PRBs in double are exact and do not depend on their order:
    a reader of the log gets the same bits.
    """
    power, snr = state.fading_power[env].reshape(-1), state.snr[env]
    rate = state.prb_rate_mbps[env].reshape(-1)
    for i in range(power.shape[0]):
        snr_i = snr[i] * np.float64(power[i])
        rate[i] = np.float32(me.prb_bandwidth_mhz * log2_f64(1.0 + snr_i))


@DELIVER.kernel(ShannonWords)
def deliver(me: ShannonWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Sum of the rates of each user's PRBs."""
    rate, count = slot.rate_mbps, slot.num_prb
    for user in range(rate.shape[0]):
        rate[user] = 0.0
        count[user] = 0
    for prb in range(slot.prb_owner.shape[0]):
        owner = np.int64(slot.prb_owner[prb])
        rate[owner] += np.float64(state.prb_rate_mbps[env, owner, prb])
        count[owner] += 1
