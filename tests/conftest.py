"""Shared settings: one thread, no display, repeatable property tests."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

# Before NumPy loads: the bits of a matrix product depend on the number of threads.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
os.environ.setdefault("MPLBACKEND", "Agg")

import numpy as np  # noqa: E402
import pytest  # noqa: E402
from hypothesis import HealthCheck, settings  # noqa: E402

if TYPE_CHECKING:
    from hiersched.scenario import Scenario
    from hiersched.simulator.gains import LoopGains

# Compiling a Numba kernel takes seconds on its first call, so no deadline;
# derandomised, so that a run that passes here passes everywhere.
settings.register_profile(
    "hiersched",
    deadline=None,
    derandomize=True,
    max_examples=50,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("hiersched")


@pytest.fixture(scope="session")
def project_root() -> Path:
    """The root folder of the checkout."""
    return Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def smoke_scenario(project_root: Path) -> Scenario:
    """The small scenario: 4 URLLC and 4 eMBB users, 10 PRBs."""
    from hiersched.scenario import load_scenario

    config = project_root / "config"
    return load_scenario(config / "scenarios" / "smoke.yaml", defaults=config / "defaults.yaml")


@pytest.fixture(scope="session")
def nominal_gains() -> Callable[[Scenario], LoopGains]:
    """The nominal gain at every delay, for a scenario's sampling interval and weight."""
    from hiersched.simulator.gains import LoopGains, plant_of

    made: dict[object, LoopGains] = {}

    def gains(scenario: Scenario) -> LoopGains:
        if scenario.control not in made:
            K = plant_of(scenario).nominal_gain
            network = np.repeat(K[None], scenario.max_delay_steps + 1, axis=0)
            made[scenario.control] = LoopGains.memoryless(network)
        return made[scenario.control]

    return gains


@pytest.fixture(scope="session")
def scenario(smoke_scenario: Scenario) -> Scenario:
    """Three URLLC and two eMBB users, episodes of six slots: for environments and learners."""
    smoke = smoke_scenario
    return replace(
        smoke,
        users=replace(smoke.users, num_urllc=3, num_embb=2),
        radio=replace(smoke.radio, num_prb=8),
        traffic=replace(smoke.traffic, urllc_offered_mbps=(12.0, 16.0, 22.0), load=1.1),
        learning=replace(smoke.learning, slots_per_episode=6),
    )


@pytest.fixture(scope="session")
def gains(scenario: Scenario, nominal_gains: Callable[[Scenario], LoopGains]) -> LoopGains:
    """The nominal gain at every delay of `scenario`."""
    return nominal_gains(scenario)
