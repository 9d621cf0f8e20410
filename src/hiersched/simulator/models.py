"""The models that a scenario names, by their place in the slot loop."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hiersched.models.channel.link_budget import snr_per_fading_power
from hiersched.models.model import Model
from hiersched.scenario.schema import Scenario


def models_of(scenario: Scenario) -> dict[str, Model]:
    """Return the models of a scenario."""
    radio, traffic = scenario.radio, scenario.traffic
    return {
        "path_loss": radio.path_loss,
        "fading": radio.fading,
        "link": radio.link,
        "report": radio.report,
        "arrivals": traffic.arrivals,
        "queue": traffic.queue,
        "plant": scenario.plant,
    }


def snr_at_unit_fading(scenario: Scenario, keys: NDArray[np.uint64]) -> NDArray[np.float64]:
    """Signal-to-noise ratios in the worlds `keys`, each user's K times, shape (E, U K), linear."""
    radio = scenario.radio
    budget = snr_per_fading_power(radio.tx_power_dbm, radio.noise_dbm)
    gains = [radio.path_loss.gain(int(key), scenario.num_users) for key in keys]
    return np.repeat(budget * np.array(gains), radio.num_prb, axis=1)
