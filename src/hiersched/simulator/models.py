"""The models that a scenario names, by their place in the slot loop."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiersched.models.channel.link_budget import snr_per_fading_power
from hiersched.models.channel.path_loss import Macro, NoPathLoss
from hiersched.models.channel.rayleigh import Rayleigh
from hiersched.models.link.shannon import Shannon
from hiersched.models.model import Belief, Model
from hiersched.models.plant.linear import Linear
from hiersched.models.plant.unicycle import Unicycle
from hiersched.models.queue.fifo import Fifo
from hiersched.models.traffic.poisson import Poisson
from hiersched.scenario.schema import Scenario


def _with(model: Any, **values: Any) -> Any:
    for name, value in values.items():
        setattr(model, name, value)
    return model


def models_of(scenario: Scenario) -> dict[str, Model]:
    """Return the models of a scenario."""
    radio, lp = scenario.radio, scenario.linear_plant
    pl = (
        NoPathLoss()
        if radio.path_loss == "none"
        else _with(
            Macro(),
            cell_radius_m=radio.cell_radius_m,
            min_distance_m=radio.min_distance_m,
            shadowing_db=radio.shadowing_db,
        )
    )
    plant = Unicycle()
    if scenario.control.plant == "linear":
        plant = _with(Linear(), **vars(lp))
    arrivals = _with(Poisson(), batch_packets=scenario.traffic.batch_packets)
    arrivals.belief = belief
    return {
        "path_loss": pl,
        "fading": _with(Rayleigh(), scale=radio.rayleigh_scale),
        "link": Shannon(),
        "report": Model(),
        "arrivals": arrivals,
        "queue": Fifo(),
        "plant": plant,
    }


def belief(scenario: Scenario) -> Belief:
    radio, traffic = scenario.radio, scenario.traffic
    num_urllc, num_embb = scenario.users.num_urllc, scenario.users.num_embb
    packet_mbit = traffic.packet_bits * 1e-6
    delay_s = (
        traffic.deadline_s if traffic.application_delay_s is None else traffic.application_delay_s
    )
    interval_s = radio.slot_s + delay_s

    def per_user(value, count):
        return np.broadcast_to(np.asarray(value, dtype=np.float64), (count,)).copy()

    offered_urllc = traffic.load * per_user(traffic.urllc_offered_mbps, num_urllc)
    offered_embb = traffic.load * per_user(traffic.embb_offered_mbps, num_embb)
    base = offered_urllc * radio.slot_s / interval_s + (
        traffic.rate_sensitivity * traffic.reference_rate_mbps
    )
    return Belief(
        offered_mbps=np.concatenate([base, offered_embb]),
        rate_sensitivity=np.repeat([traffic.rate_sensitivity, 0.0], [num_urllc, num_embb]),
        packets_per_mbps=np.repeat([interval_s, radio.slot_s], [num_urllc, num_embb]) / packet_mbit,
        mean_due_packets=np.concatenate([offered_urllc, offered_embb]) * radio.slot_s / packet_mbit,
    )


def snr_of(scenario: Scenario, path_loss: Any, keys: NDArray[np.uint64]) -> NDArray[np.float64]:
    """Signal-to-noise ratio at unit fading power, each user's K times, shape (E, U K), linear."""
    radio, num_users = scenario.radio, scenario.num_users
    budget = snr_per_fading_power(radio.tx_power_dbm, radio.noise_dbm)
    snr = np.array([budget * path_loss.gain(int(key), num_users) for key in keys])
    return np.repeat(snr, radio.num_prb, axis=1)
