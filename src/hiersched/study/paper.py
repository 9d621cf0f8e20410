"""What the paper prints: its symbols, and the numbers of its Tables II and III."""

from __future__ import annotations

from types import MappingProxyType
from typing import NamedTuple

SYMBOLS = MappingProxyType(
    {
        "users.num_urllc": "n_u",
        "users.num_embb": "n_e",
        "radio.slot_s": "τ",
        "radio.bandwidth_hz": "B",
        "radio.num_prb": "K",
        "radio.tx_power_dbm": "p",
        "radio.noise_dbm": "σ²",
        "radio.fading.scale": "s",
        "traffic.packet_bits": "L",
        "traffic.arrivals.rate_sensitivity": "α",
        "traffic.service_coefficient_mbps": "β",
        "traffic.deadline_s": "D_max",
        "traffic.arrivals.application_delay_s": "D_i",
        "traffic.reliability": "χ",
        "objective.penalty_weight": "V",
        "objective.epsilon": "ε",
        "objective.delay_exponent": "α₁",
        "objective.multiplier_step": "η",
        "robot.speed_mps": "v_r",
        "control.sampling_s": "h",
        "control.weight": "q",
        "learning.discount": "γ",
        "learning.weight_exponent": "c",
    }
)
"""Symbol of a scenario's key, in the paper's notation where it has one."""


TABLE2 = MappingProxyType({5: (0.8962, 0.7077), 10: (0.7877, 0.5609), 20: (0.8726, 0.5660)})
"""Table II by time slot: tracking errors with the nominal and the adjusted gain, in a unit that the
paper does not give."""


class RateNumbers(NamedTuple):
    """One row of Table III: channel gain and mean URLLC rates in Mbit/s."""

    channel_gain: float
    drl_mbps: float
    pf_mbps: float


TABLE3 = MappingProxyType(
    {
        5: RateNumbers(1.0481, 17.9188, 19.4697),
        10: RateNumbers(1.0645, 19.6458, 19.2875),
        15: RateNumbers(1.8141, 19.7586, 19.9794),
    }
)
"""Table III by time slot."""
