"""The co-simulator: network and robots in one slot loop over a batch of worlds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hiersched.policies.rules import CLASSICAL
from hiersched.scenario.schema import Scenario
from hiersched.simulator.loop import GIVEN, draw_channels, run_robots, run_slots
from hiersched.simulator.record import SlotLayout, SlotRecord
from hiersched.simulator.robot_setup import Gains
from hiersched.simulator.setup import (
    SlotConstants,
    SlotState,
    initial_state,
    slot_constants,
    slot_scratch,
)

__all__ = ["Gains", "Simulator", "SlotConstants", "SlotRecord", "SlotState"]


class Simulator:
    """A batch of worlds that share one scenario.

    Parameters
    ----------
    scenario
        The validated scenario.
    gains
        Gain schedule of the robots.
    keys
        Worlds, shape (E,), from `randomness.world_key`.
    num_slots
        Slots until the horizon.

    Raises
    ------
    ValueError
        If gains and scenario do not fit.
    """

    def __init__(
        self, scenario: Scenario, gains: Gains, keys: NDArray[np.uint64], num_slots: int
    ) -> None:
        self.scenario = scenario
        self.num_slots = num_slots
        self.constants: SlotConstants = slot_constants(scenario, gains, num_slots)
        self.state: SlotState = initial_state(scenario, keys, num_slots)
        self._scratch = slot_scratch(self.constants, scenario.robot_sizes)
        self._ones = np.ones((len(keys), scenario.num_users))
        self._zeros = np.zeros((len(keys), scenario.users.num_urllc))
        self._no_owners = np.zeros((0, 0, 0), np.uint32)
        self._layout = SlotLayout(
            scenario.num_users,
            scenario.users.num_urllc,
            scenario.radio.num_prb,
            scenario.robot_sizes,
        )
        draw_channels(self.constants, self.state, self._scratch)

    @property
    def num_envs(self) -> int:
        """Worlds in the batch."""
        return len(self.state.key)

    @property
    def slots_left(self) -> int:
        """Slots until the horizon."""
        return self.num_slots - int(self.state.slot.max())

    def reset(self, keys: NDArray[np.uint64]) -> None:
        """Start anew in the worlds `keys`, shape (E,).

        Raises
        ------
        ValueError
            If the number of worlds differs.
        """
        if len(keys) != self.num_envs:
            raise ValueError(f"{len(keys)} worlds, must be {self.num_envs}")
        self.state = initial_state(self.scenario, keys, self.num_slots)
        draw_channels(self.constants, self.state, self._scratch)

    def run(
        self,
        policy: str,
        num_slots: int | None = None,
        *,
        weights: NDArray[np.float64] | None = None,
        multipliers: NDArray[np.float64] | None = None,
        record: SlotRecord | None = None,
    ) -> SlotRecord:
        """Run all worlds under a classical scheduler, plain or with users weighted.

        Parameters
        ----------
        policy
            Name of a classical scheduler.
        num_slots
            Slots to run; up to the horizon unless given.
        weights
            Factors of the users' utilities, shape (E, U), held for all these slots; 1 unless given.
            Round robin and EDF have no utility and leave them unused.
        multipliers
            Multiplier of each URLLC user's delay constraint, shape (E, R); 0 unless given.
        record
            Is filled and returned; a new one unless given.

        Raises
        ------
        ValueError
            On an unknown policy, weights that are not positive and finite, or slots beyond the
            horizon.
        """
        if policy not in CLASSICAL:
            raise ValueError(f"policy = {policy!r}: must be one of {', '.join(CLASSICAL)}")
        if num_slots is None:
            num_slots = self.slots_left if record is None else record.prb_owner.shape[1]
        return self._run(
            CLASSICAL[policy], num_slots, weights, multipliers, self._no_owners, record
        )

    def run_owners(
        self,
        prb_owner: NDArray[np.uint32],
        *,
        weights: NDArray[np.float64] | None = None,
        multipliers: NDArray[np.float64] | None = None,
        record: SlotRecord | None = None,
    ) -> SlotRecord:
        """Run all worlds under a given allocation, such as that of a log.

        Parameters
        ----------
        prb_owner
            Owner of each PRB, shape (E, T, K): T slots are run.
        weights, multipliers, record
            As for `run`; the weights are only recorded.

        Raises
        ------
        ValueError
            On owners of another shape, of users that are not there, or that leave a user without a
            PRB; else as `run`.
        """
        num_prb, num_users = self.scenario.radio.num_prb, self.scenario.num_users
        if prb_owner.ndim != 3 or prb_owner.shape[::2] != (self.num_envs, num_prb):
            raise ValueError(
                f"prb_owner: shape {prb_owner.shape}, must be ({self.num_envs}, slots, {num_prb})"
            )
        held = (prb_owner[..., None] == np.arange(num_users)).any(axis=2)
        if not held.all() or (prb_owner >= num_users).any():
            raise ValueError(
                f"prb_owner: every user 0 to {num_users - 1} must own a PRB, and nobody else"
            )
        owners = np.ascontiguousarray(prb_owner, dtype=np.uint32)
        return self._run(GIVEN, prb_owner.shape[1], weights, multipliers, owners, record)

    def _run(
        self,
        scheduler: int,
        num_slots: int,
        weights: NDArray[np.float64] | None,
        multipliers: NDArray[np.float64] | None,
        owners: NDArray[np.uint32],
        record: SlotRecord | None,
    ) -> SlotRecord:
        if not 0 < num_slots <= self.slots_left:
            raise ValueError(f"num_slots = {num_slots}: must be 1 to {self.slots_left}")
        if weights is None:
            weights = self._ones
        elif weights.shape != self._ones.shape or not (
            np.isfinite(weights).all() and (weights > 0).all()
        ):
            raise ValueError(f"weights: must be positive and finite, shape {self._ones.shape}")
        if record is None:
            record = self.new_record(num_slots)
        elif record.prb_owner.shape[:2] != (self.num_envs, num_slots):
            raise ValueError(
                f"record: {record.prb_owner.shape[:2]} environments and slots, must be "
                f"{(self.num_envs, num_slots)}"
            )
        run_slots(
            self.constants,
            self.state,
            self._scratch,
            scheduler,
            weights,
            self._zeros if multipliers is None else multipliers,
            owners,
            record.rows,
        )
        return record

    def run_robots(self, network_delay_s: NDArray[np.float64]) -> SlotRecord:
        """Run the robots alone under forced network delays, shape (E, T, R).

        What belongs to the network stays 0 in the record.

        Raises
        ------
        ValueError
            On delays of another shape, negative or not finite, or slots beyond the horizon.
        """
        record = self.new_record(network_delay_s.shape[1])
        if network_delay_s.shape != record.network_delay_s.shape:
            raise ValueError(
                f"network_delay_s: shape {network_delay_s.shape}, must be "
                f"{record.network_delay_s.shape}"
            )
        if not (np.isfinite(network_delay_s).all() and (network_delay_s >= 0).all()):
            raise ValueError("network_delay_s: must be finite and not negative")
        if network_delay_s.shape[1] > self.slots_left:
            raise ValueError(
                f"network_delay_s: {network_delay_s.shape[1]} slots, at most {self.slots_left}"
            )
        run_robots(self.constants, self.state, self._scratch, network_delay_s, record.rows)
        return record

    def new_record(self, num_slots: int) -> SlotRecord:
        """Zeroed record for `num_slots` slots of all worlds."""
        return self._layout.record(self.num_envs, num_slots)
