"""Compiles the slot loop ahead of the jobs; `hiersched.core.compiled` keeps the machine code.

Those of the models of `smoke`: what a scenario or a plug-in brings beside them is compiled where it
is first used.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hiersched.core.randomness import world_keys
from hiersched.experiments.points import experiments
from hiersched.models.model import Setup
from hiersched.policies.features import num_features
from hiersched.policies.index_rules import CLASSICAL
from hiersched.policies.learned import NETWORKS, layer_sizes, network_words, num_parameters
from hiersched.policies.policy import Weigher
from hiersched.scenario import Scenario, load_scenario
from hiersched.simulator import Simulator
from hiersched.simulator.loop_gains import nominal_gains


def compile_kernels() -> None:
    """Compile every kernel that a stage calls, by running a slot of the smallest scenario."""
    scenario = load_scenario("smoke")
    gains = nominal_gains(scenario)
    keys = world_keys("compile", 0, 1)
    simulator = Simulator(scenario, gains, keys, len(CLASSICAL) + len(NETWORKS))
    for name in CLASSICAL:
        simulator.run(name, 1)
        simulator.decide(simulator.rule(name))
    for network in NETWORKS:
        simulator.run(_Untrained(scenario, network), 1)
    none = np.zeros((1, scenario.users.num_urllc))
    simulator.features(none)
    simulator.set_channel(simulator.state.fading_power.copy())
    forced = experiments(scenario)["gain_study"].points[0].delays
    assert forced is not None
    Simulator(scenario, gains, keys, 2).run_robots(forced.draw(scenario, keys, 2))


class _Untrained(Weigher):
    """A network of zeros."""

    def __init__(self, scenario: Scenario, network: str) -> None:
        self.rule, self.multipliers = "pf", np.zeros(scenario.users.num_urllc)
        self._network = network

    def words(self, setup: Setup) -> Any:
        """As in `Weigher`."""
        users = setup.scenario.users
        counts = {"num_urllc": users.num_urllc, "num_embb": users.num_embb}
        hidden = () if self._network == "linear" else (1,)
        sizes = layer_sizes(self._network, hidden, num_features(False, False), **counts)
        return network_words(
            np.zeros((2, num_parameters(sizes)), np.float32),
            self._network,
            hidden,
            observe_robots=False,
            observe_demand=False,
            weight_exponent=1.0,
            **counts,
        )
