"""Compiles the slot loop ahead of the jobs; `hiersched.core.compiled` keeps the machine code."""

from __future__ import annotations

import numpy as np

from hiersched.core.randomness import world_keys
from hiersched.runs.gain_study import forced_delays
from hiersched.scenario import load_scenario
from hiersched.simulator import Simulator
from hiersched.simulator.loop_gains import LoopGains


def compile_kernels() -> None:
    """Compile every kernel that a stage calls, by running two slots of the smallest scenario."""
    scenario = load_scenario("smoke")
    gains = LoopGains.memoryless(np.zeros((scenario.max_delay_steps + 1, 2, 5)))
    keys = world_keys("compile", 0, 1)
    Simulator(scenario, gains, keys, 2).run("pf")
    delays = forced_delays(scenario, keys, 2, scenario.users.num_urllc)
    Simulator(scenario, gains, keys, 2).run_robots(delays)
