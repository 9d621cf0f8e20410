"""Made-up worlds: what the kernels of policies read, without a simulator."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from hiersched.core.compiled import kernel
from hiersched.core.pointer import Pointer
from hiersched.core.seam import call_plug
from hiersched.policies.seams import WEIGH


class Loop(NamedTuple):
    core_latency_s: float
    sampling_s: float
    max_delay_steps: int


class Constants(NamedTuple):
    num_urllc: int
    num_prb: int
    slot_s: float
    deadline_s: NDArray[np.float64]  # (U,)
    mean_due_packets: NDArray[np.float64]  # (U,)
    service_packets_per_mbps: float
    loop: Loop


class State(NamedTuple):
    reported_rate_mbps: NDArray[np.float32]  # (E, U, K)
    backlog_packets: NDArray[np.float64]  # (E, U)
    hol_delay_s: NDArray[np.float64]  # (E, U)
    rate_mbps: NDArray[np.float64]  # (E, U)
    dexterity_index: NDArray[np.float64]  # (E, R)
    multiplier: NDArray[np.float64]  # (E, R)
    gain_delay_steps: NDArray[np.uint32]  # (E, R)
    robot_state: NDArray[np.float64]  # (E, R, N)
    set_point_age_s: NDArray[np.float64]  # (E, R), and so are the next four
    set_point_speed_mps: NDArray[np.float64]
    set_point_acceleration_mps2: NDArray[np.float64]
    set_point_gap_m: NDArray[np.float64]
    reported_error_m: NDArray[np.float64]
    weight: NDArray[np.float64]  # (E, U)


class Slot(NamedTuple):
    slot: int


def random_worlds(
    num_urllc: int = 10, num_embb: int = 10, *, num_prb: int = 25, num_envs: int = 3, seed: int = 1
) -> tuple[Constants, State]:
    """Worlds with queues, waits and rates of usual size, some of the queues empty.

    The first worlds are the same for every `num_envs`.
    """
    num_users = num_urllc + num_embb
    users = np.random.default_rng(seed)
    constants = Constants(
        num_urllc=num_urllc,
        num_prb=num_prb,
        slot_s=0.01,
        deadline_s=users.choice([0.02, 0.035, 0.1], num_users),
        mean_due_packets=users.uniform(1.0, 30.0, num_users),
        service_packets_per_mbps=1.0,
        loop=Loop(core_latency_s=0.005, sampling_s=0.02, max_delay_steps=6),
    )
    worlds = []
    for env in range(num_envs):
        rng = np.random.default_rng((seed, env))
        backlog = rng.exponential(40.0, num_users) * (rng.random(num_users) < 0.8)
        worlds.append(
            State(
                reported_rate_mbps=rng.gamma(2.0, 5.0, (num_users, num_prb)).astype(np.float32),
                backlog_packets=backlog,
                hol_delay_s=rng.exponential(0.03, num_users) * (backlog > 0),
                rate_mbps=rng.exponential(20.0, num_users),
                dexterity_index=rng.random(num_urllc),
                multiplier=rng.exponential(1.0, num_urllc),
                gain_delay_steps=rng.integers(0, 7, num_urllc, dtype=np.uint32),
                robot_state=rng.normal(scale=0.05, size=(num_urllc, 5)),
                set_point_age_s=rng.exponential(0.05, num_urllc),
                set_point_speed_mps=rng.exponential(0.5, num_urllc),
                set_point_acceleration_mps2=rng.exponential(2.0, num_urllc),
                set_point_gap_m=rng.exponential(0.02, num_urllc),
                reported_error_m=rng.exponential(0.02, num_urllc),
                weight=np.ones(num_users),
            )
        )
    return constants, State(*map(np.stack, zip(*worlds, strict=True)))


@kernel()
def _weigh_all(plug, constants, state, slot, num_envs):
    for env in range(num_envs):
        call_plug(plug, constants, state, slot, env)


def weigh_worlds(words, constants: Constants, state: State) -> NDArray[np.float64]:
    """Weights (E, U) of a policy's words, by its kernel in the seam WEIGH."""
    pointers = Pointer(constants), Pointer(state), Pointer(Slot(0))
    plug, _kept = WEIGH.plug(words, *pointers)
    _weigh_all(plug, *pointers, len(state.weight))
    return state.weight.copy()


# Test modules cannot import each other or this one.


@pytest.fixture(scope="session")
def make_worlds():
    """`random_worlds`."""
    return random_worlds


@pytest.fixture(scope="session")
def weigh():
    """`weigh_worlds`."""
    return weigh_worlds
