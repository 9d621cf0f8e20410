"""How the loops of a study grow over the delays that their networks gave."""

from __future__ import annotations

import numpy as np
import pandas as pd

from hiersched.control.checks import FloatArray
from hiersched.control.second_moments import transition_counts
from hiersched.scenario import Scenario
from hiersched.simulator.loop_growth import unheld_growths
from hiersched.study.study import Study


def has_network_loop(scenario: Scenario) -> bool:
    """Whether all feedback crosses the network, so that its delays decide what the loop does."""
    return scenario.loop_kind == "network"


def robot_counts(chains: pd.DataFrame) -> list[FloatArray]:
    """Return how often each delay of a robot followed another, robot by robot."""
    names = "delay_steps", "next_steps", "count"
    return [transition_counts(*(own[name] for name in names)) for _, own in chains.groupby("robot")]


def greatest_growths(study: Study) -> dict[str, float]:
    """Return the growth of each policy's worst loop, without the hold; NaN: not known."""
    scenario = study.scenario
    schedule, chains = study.schedule(scenario), study.measures("chains")
    return {
        str(policy): float(np.max(unheld_growths(scenario, schedule, robot_counts(own))))
        for policy, own in chains.groupby("policy", sort=False)
    }
