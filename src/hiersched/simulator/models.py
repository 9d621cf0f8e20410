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
    """Signal-to-noise ratios in the worlds `keys`, each user's K times, shape (E, U K), linear.

    Raises
    ------
    ValueError
        If the path loss does not return a positive gain of every user.
    """
    radio, shape = scenario.radio, (scenario.num_users,)
    budget = snr_per_fading_power(radio.tx_power_dbm, radio.noise_dbm)
    gains = [np.asarray(radio.path_loss.gain(int(key), scenario.num_users)) for key in keys]
    for gain in gains:
        if gain.shape != shape or not (np.isfinite(gain).all() and (gain > 0.0).all()):
            kind = type(radio.path_loss)
            raise ValueError(
                f"{kind.__module__}.{kind.__qualname__}.gain returned {gain}: must be positive and "
                f"finite, shape {shape}"
            )
    return np.repeat(budget * np.array(gains, np.float64), radio.num_prb, axis=1)
