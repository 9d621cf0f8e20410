"""Shannon's rate of every resource block, delivered as reported: r = B log2(1 + snr |h|^2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.core.compiled import kernel
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


@kernel()
def prb_rates(
    fading_power: NDArray[np.float32],
    snr: NDArray[np.float64],
    prb_bandwidth_mhz: float,
    rate_mbps: NDArray[np.float32],
) -> None:
    """Rate of every user on every PRB, in place: B log2(1 + snr |h|^2).

    Parameters
    ----------
    fading_power
        Squared fading amplitude, shape (U*K,), user by user.
    snr
        Signal-to-noise ratio at unit fading power, shape (U*K,), linear: each user's value K times.
    prb_bandwidth_mhz
        Bandwidth of one PRB.
    rate_mbps
        Result, shape (U*K,). Rounded to float32, so that sums over PRBs in double are exact and do
        not depend on their order: a reader of the log gets the same bits.
    """
    for i in range(fading_power.shape[0]):
        snr_i = snr[i] * np.float64(fading_power[i])
        rate_mbps[i] = np.float32(prb_bandwidth_mhz * log2_f64(1.0 + snr_i))


@RATE_PRBS.kernel(ShannonWords)
def rate_prbs(me: ShannonWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Rate of the coming slot."""
    prb_rates(
        state.fading_power[env].reshape(-1),
        state.snr[env],
        me.prb_bandwidth_mhz,
        state.prb_rate_mbps[env].reshape(-1),
    )


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
