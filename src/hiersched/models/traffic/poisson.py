"""Poisson arrivals in batches, whose mean falls with the rate: max(0, lambda_0 - alpha r).

The uniform, not the count, is the world's: the Poisson quantile of it depends on the rate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from hiersched.allocation.objective import mean_arrivals
from hiersched.core.compiled import kernel
from hiersched.core.numerics import exp_f64
from hiersched.core.parameters import Count, NonNegative, Note
from hiersched.models.model import ARRIVALS, Arrivals, Belief, Setup
from hiersched.models.seams import OFFER

if TYPE_CHECKING:
    from hiersched.scenario.schema import Scenario

LANES = 32
"""Users side by side. A block of them is one flat array, field after field: with offsets that the
compiler knows, it proves that fields do not overlap, and uses whole vectors."""

MAX_MEAN = 600.0
"""Largest mean of `poisson_quantiles`: exp(-mean) must stay a normal double."""

NEGLIGIBLE_TERM = 1e-17
"""Far in the tail the sum may have rounded below the uniform: no later term changes it."""

# Far beyond the largest k that a double in (0, 1) can reach at MAX_MEAN.
_RECIPROCAL = np.concatenate([[0.0], 1.0 / np.arange(1, 4096)])

UNIFORM, MEAN, QUANTILE, _TERM, _SUM, NUM_ARRIVAL_LANES = (LANES * place for place in range(6))


class PoissonWords(NamedTuple):
    """Packets a batch; work lanes. The rest is the belief of the base station, true here."""

    batch_packets: int
    lanes: NDArray[np.float64]


@ARRIVALS.model
@dataclass(frozen=True, kw_only=True)
class Poisson(Arrivals):
    """Batches of packets, Poisson a slot; URLLC arrivals fall with the user's data rate."""

    model: Annotated[
        Literal["poisson"], Note("model", "assumed", "poisson (batches of packets, every slot)")
    ] = "poisson"
    batch_packets: Annotated[
        Count,
        Note("packets", "assumed", "packets arrive in batches of this size (1 = plain Poisson)"),
    ]
    rate_sensitivity: Annotated[
        float,
        Field(ge=0, lt=1),
        Note("1", "paper", "alpha, arrivals fall by alpha times the data rate"),
    ]
    reference_rate_mbps: Annotated[
        NonNegative, Note("Mbit/s", "assumed", "data rate at which urllc_offered_mbps holds")
    ]
    application_delay_s: Annotated[
        NonNegative | None,
        Note(
            "s",
            "assumed",
            "D_i in the arrival interval tau + D_i; null = deadline_s, as in the queue equation",
        ),
    ]

    def belief(self, scenario: Scenario) -> Belief:
        """As in `Arrivals`; eMBB arrivals depend on no rate."""
        slot_s, traffic = scenario.radio.slot_s, scenario.traffic
        num_urllc, num_embb = scenario.users.num_urllc, scenario.users.num_embb
        packet_mbit = traffic.packet_bits * 1e-6
        delay_s = self.application_delay_s
        interval_s = slot_s + (traffic.deadline_s if delay_s is None else delay_s)
        offered = self.offered_mbps(scenario)
        offered_urllc, offered_embb = offered[:num_urllc], offered[num_urllc:]
        # lambda_0 such that the load at the reference rate is the offered one: the interval of the
        # arrivals is longer than a slot, so lambda_0 is smaller than the load.
        base = offered_urllc * slot_s / interval_s + (
            self.rate_sensitivity * self.reference_rate_mbps
        )
        return Belief(
            offered_mbps=np.concatenate([base, offered_embb]),
            rate_sensitivity=np.repeat([self.rate_sensitivity, 0.0], [num_urllc, num_embb]),
            packets_per_mbps=np.repeat([interval_s, slot_s], [num_urllc, num_embb]) / packet_mbit,
            mean_due_packets=np.concatenate([offered_urllc, offered_embb]) * slot_s / packet_mbit,
        )

    def packets_at_once(self) -> float:
        """Return the size of a batch."""
        return float(self.batch_packets)

    def faults(self, scenario: Scenario) -> list[str]:
        """Say where mean batches a slot are beyond what the Poisson quantile can sum."""
        load, belief = scenario.traffic.load, self.belief(scenario)
        batches = (belief.offered_mbps * belief.packets_per_mbps).max() / self.batch_packets
        if self.batch_packets * len(_RECIPROCAL) >= 1 << 32:
            return [
                f"traffic.arrivals.batch_packets = {self.batch_packets}: must be below "
                f"{(1 << 32) // len(_RECIPROCAL)}, since arrivals of a slot have 32 bits"
            ]
        if batches <= MAX_MEAN:
            return []
        return [
            f"traffic.load = {load}: up to {batches:.6g} batches a slot and user on "
            f"average, must stay within {MAX_MEAN:g} (lower the load or the offered rates, or "
            "raise traffic.packet_bits or traffic.arrivals.batch_packets)"
        ]

    def words(self, setup: Setup) -> PoissonWords:
        """As in `Model`; ValueError if a user's mean arrivals are beyond the Poisson quantile."""
        if faults := self.faults(setup.scenario):
            raise ValueError(faults[0])
        blocks = -(-setup.scenario.num_users // LANES)
        return PoissonWords(self.batch_packets, np.zeros((blocks, NUM_ARRIVAL_LANES)))


@OFFER.kernel(PoissonWords)
def offer_poisson(me: PoissonWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Arrivals of a world's slot at the rates that it was given."""
    batch = np.float64(me.batch_packets)
    num_users = slot.rate_mbps.shape[0]
    for block in range(me.lanes.shape[0]):
        lanes, begin = me.lanes[block], block * LANES
        count = min(LANES, num_users - begin)
        for lane in range(count):
            user = begin + lane
            rate = slot.rate_mbps[user]
            offered, sensitivity = constants.offered_mbps[user], constants.rate_sensitivity[user]
            per_mbps = constants.arrival_packets_per_mbps[user]
            mean = mean_arrivals(rate, offered, sensitivity, per_mbps)
            slot.arrival_clamped[user] = 1 if offered - sensitivity * rate < 0.0 else 0
            lanes[UNIFORM + lane] = slot.arrival_uniform[user]
            lanes[MEAN + lane] = mean / batch
        poisson_quantiles(lanes)
        for lane in range(count):
            slot.arrivals_packets[begin + lane] = np.uint32(batch * lanes[QUANTILE + lane])


@kernel(forceinline=True)
def poisson_quantiles(lanes: NDArray[np.float64]) -> None:
    """Poisson quantiles of a block of users: the least k whose distribution reaches the uniform.

    LANES of each are read, `UNIFORM` in (0, 1), 0 without a user, and `MEAN`, at most MAX_MEAN, and
    `QUANTILE` is written. The users' sums run side by side until the last has ended: one after the
    other, each would end at an unforeseeable place, which stalls the processor.
    """
    for lane in range(LANES):
        lanes[_TERM + lane] = exp_f64(-lanes[MEAN + lane])
        lanes[_SUM + lane] = lanes[_TERM + lane]
        lanes[QUANTILE + lane] = 0.0
    k = 0
    open_users = 1
    while open_users > 0:
        k += 1
        reciprocal = _RECIPROCAL[k]
        count = np.float64(k)
        open_users = 0
        for lane in range(LANES):
            is_open = lanes[_SUM + lane] < lanes[UNIFORM + lane]
            mean = lanes[MEAN + lane]
            term = lanes[_TERM + lane] * (mean * reciprocal)
            ended = is_open and term < NEGLIGIBLE_TERM and count > mean
            lanes[QUANTILE + lane] += 1.0 if is_open else 0.0
            lanes[_TERM + lane] = term
            lanes[_SUM + lane] = 2.0 if ended else lanes[_SUM + lane] + term
            open_users += 1 if is_open else 0
