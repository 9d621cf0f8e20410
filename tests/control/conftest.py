from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from hiersched.control import build_schedule, network_plant, split_plant, tracking_weights


def unicycle(sampling_s):
    """Error model at 1 m/s on a straight line with 0.1 s lag (written out: rooms stay apart)."""
    block = np.zeros((7, 7))
    block[0, 3] = block[1, 2] = block[2, 4] = 1.0
    block[3, 3] = block[4, 4] = -10.0
    block[3, 5] = block[4, 6] = 10.0
    transition = expm(block * sampling_s)
    return transition[:5, :5], transition[:5, 5:]


@pytest.fixture(scope="session")
def make_network_plant():
    def make(weight=700.0, sampling_s=0.02):
        weights = tracking_weights(weight, sampling_s)
        return network_plant(*unicycle(sampling_s), *weights, sampling_s=sampling_s)

    return make


@pytest.fixture(scope="session")
def make_split_plant():
    def make(weight=100.0, operator_share=0.3, sampling_s=0.02):
        return split_plant(
            *unicycle(sampling_s),
            *tracking_weights(weight, sampling_s),
            operator_share=operator_share,
            operator_states=(0, 1, 2),
            sampling_s=sampling_s,
        )

    return make


@pytest.fixture(scope="session")
def schedule(make_network_plant):
    """The table of the gain study: q = 700, h = 20 ms, C3, T = 0..12."""
    return build_schedule(make_network_plant(), 12, "krasovskii")


@pytest.fixture(scope="session")
def fridman():
    """Fridman (2014), p. 250: x(k+1) = A x(k) + A1 x(k-d)."""
    return np.array([[0.8, 0.0], [0.0, 0.97]]), np.array([[-0.1, 0.0], [-0.1, -0.1]])


@pytest.fixture(scope="session")
def simulate():
    def run(A_c, A_d, delays, x0):
        """Return the states of x(k+1) = A_c x(k) + A_d x(k-d(k)), x(k) = x0 for k <= 0."""
        states = [x0]
        for k, delay in enumerate(delays):
            late = states[max(k - int(delay), 0)]
            states.append(A_c @ states[-1] + A_d @ late)
        return np.array(states)

    return run
