from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hiersched.control import dlqr, tracking_weights
from hiersched.robot.plant import discretise, unicycle_error_model
from hiersched.scenario import Scenario, load_scenario


@pytest.fixture(scope="session")
def scenario(project_root: Path) -> Scenario:
    """Three URLLC and two eMBB users, episodes of six slots."""
    smoke = load_scenario(project_root / "config" / "scenarios" / "smoke.yaml")
    return replace(
        smoke,
        users=replace(smoke.users, num_urllc=3, num_embb=2),
        radio=replace(smoke.radio, num_prb=8),
        traffic=replace(smoke.traffic, urllc_offered_mbps=(12.0, 16.0, 22.0), load=1.1),
        learning=replace(smoke.learning, slots_per_episode=6),
    )


@pytest.fixture(scope="session")
def gains(scenario: Scenario) -> SimpleNamespace:
    """The nominal gain at every delay."""
    sampling_s = scenario.control.sampling_s
    A, B = discretise(*unicycle_error_model(1.0, 0.0, scenario.robot.actuator_lag_s), sampling_s)
    K, _, _ = dlqr(A, B, *tracking_weights(scenario.control.weight, sampling_s))
    count = scenario.max_delay_steps + 1
    return SimpleNamespace(
        local_gains=np.zeros((count, 2, 5)), network_gains=np.repeat(K[None], count, axis=0)
    )
