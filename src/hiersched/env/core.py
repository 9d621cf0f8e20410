"""One slot of all worlds under the agents' actions: what every adapter and the trainer share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from gymnasium import logger
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from hiersched.core.extras import naming_extras
from hiersched.core.randomness import world_key
from hiersched.policies.features import LEAST_PACKETS, SPEED_FLOOR_M2PS2
from hiersched.policies.policy import Weigher, action_weights
from hiersched.scenario import load_scenario
from hiersched.scenario.schema import Learning, Scenario
from hiersched.simulator import Gains, Simulator, SlotRecord
from hiersched.simulator.gain_source import scenario_gains

if TYPE_CHECKING:
    from hiersched.env.picture import Pictures

RENDER_MODES = ("rgb_array",)
_CONTROL_COST_S2PM2 = 16.0
"""Of the control drift: 0.8 times the packets' drift for a robot that stands, 16.8 at 1 m/s."""


def as_scenario(scenario: Scenario | str | Path) -> Scenario:
    """Return a scenario as it is, or load it by the name of a shipped one or by its path."""
    return scenario if isinstance(scenario, Scenario) else load_scenario(scenario)


def task_costs(record: SlotRecord, learning: Learning) -> NDArray[np.float64]:
    """Price of each robot's tracking error in one slot, on the scale of the rewards, shape (E, R).

    The leading axes of `record` are (E, 1).
    """
    price: float = learning.task_weight * 100.0 / learning.reward_scale
    cost: NDArray[np.float64] = price * record.tracking_error_m[:, 0]
    return cost


def control_weights(simulator: Simulator) -> NDArray[np.float64]:
    """Return what the drift of each URLLC user costs its robot's control now, shape (E, R).

    c = 16 s^2/m^2 (v_0^2 + v^2) (L / l)^2, v the speed of the newest set-point, l the packets that
    the user has a slot and L their mean: with a queue of F packets the robot lags by F / l slots,
    and a lag of D costs (v D)^2. The generalised c-mu rule has the same weight (Van Mieghem 1995;
    Mandelbaum and Stolyar 2004), so an agent that pays for this drift is told the rule.
    """
    constants, speed_mps = simulator.constants, simulator.state.set_point_speed_mps
    packets = np.maximum(constants.mean_due_packets[: constants.num_urllc], LEAST_PACKETS)
    weights: NDArray[np.float64] = (
        _CONTROL_COST_S2PM2 * (SPEED_FLOOR_M2PS2 + speed_mps**2) * (packets.mean() / packets) ** 2
    )
    return weights


def agent_views(
    features: NDArray[np.floating], num_urllc: int
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Give each agent its users' features, their slice's mean and the other slice's mean.

    `features` have shape (..., U, F), URLLC users first; the views of the agents `urllc` and `embb`
    have (..., n, 3 F) with the users n of the slice.
    """
    parts = features[..., :num_urllc, :], features[..., num_urllc:, :]
    means = [part.mean(axis=-2, keepdims=True) for part in parts]
    urllc, embb = (
        np.concatenate([part, *(np.broadcast_to(means[j], part.shape) for j in order)], axis=-1)
        for part, order in zip(parts, ((0, 1), (1, 0)), strict=True)
    )
    return urllc, embb


class EpisodeWorlds:
    """Worlds 0, 1, 2, … of a seed, `count` of them side by side in an episode."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._seed = 0
        self._next = 0

    def coming(self) -> NDArray[np.uint64]:
        """Keys of the next episode's worlds, shape (count,)."""
        indices = range(self._next, self._next + self._count)
        return np.array([world_key("env", self._seed, index) for index in indices], np.uint64)

    def take(self, seed: int | None = None) -> NDArray[np.uint64]:
        """Give the next episode's keys and go on; with a seed, begin with its first worlds."""
        if seed is not None:
            self._seed, self._next = seed, 0
        keys = self.coming()
        self._next += self._count
        return keys

    def require_episode(self, call: str) -> None:
        """Raise ResetNeeded, which names the `call`, if no episode has begun."""
        if self._next == 0:
            raise ResetNeeded(f"{call}: the first episode has not begun: call reset first")


class SlotLoop:
    """Episodes of a fixed length in E worlds; an action is a number in [-1, 1] for every user.

    Its weight multiplies the user's utility under the scheduler `learning.start`, or its drift
    (`learning.weighs`).

    Parameters
    ----------
    scenario
        The validated scenario.
    gains
        Gains of the robots; `scenario_gains` unless given.
    keys
        Worlds of the first episode, shape (E,).
    num_slots
        Slots of an episode; those of the scenario's training unless given.
    render_mode
        ``rgb_array`` keeps the last slots for `render`, which needs the extra `render`.

    Attributes
    ----------
    record
        The last slot, leading axes (E, 1); overwritten by the next one.
    task_costs
        What the task adds to the cost of each URLLC user's last slot, shape (E, R), on the scale of
        the rewards: `learning.task_weight`, `learning.reward_terms`.
    multipliers
        Multiplier of each URLLC user's delay constraint, shape (E, R); seen by the agents and
        priced in the rewards.
    """

    def __init__(
        self,
        scenario: Scenario,
        gains: Gains | None,
        keys: NDArray[np.uint64],
        num_slots: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        gains = scenario_gains(scenario) if gains is None else gains
        num_slots = scenario.learning.slots_per_episode if num_slots is None else num_slots
        if num_slots < 1 or not len(keys):
            raise ValueError(f"{len(keys)} worlds of {num_slots} slots: must be 1 or more of both")
        self.simulator = Simulator(scenario, gains, keys, num_slots)
        self.record: SlotRecord = self.simulator.new_record(1)
        self.multipliers = np.zeros((len(keys), scenario.users.num_urllc))
        self.task_costs = np.zeros_like(self.multipliers)
        self._learning = scenario.learning
        self._pictures = None if render_mode is None else _pictures(self.simulator, render_mode)

    @property
    def finished(self) -> bool:
        """Whether the episode's last slot has run."""
        return self.simulator.slots_left == 0

    def reset(self, keys: NDArray[np.uint64]) -> NDArray[np.float32]:
        """Start an episode in the worlds `keys`, shape (E,); returns features (E, U, F)."""
        self.simulator.reset(keys)
        if self._pictures is not None:
            self._pictures.clear()
        return self.features()

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Draw the last slots of every world, shape (height, width, 3) each.

        None and Gymnasium's warning without a render mode.
        """
        if self._pictures is None:
            logger.warn(f"render: no render_mode was given; must be {', '.join(RENDER_MODES)}")
            return None
        return tuple(self._pictures.draw(env) for env in range(self.simulator.num_envs))

    def features(self) -> NDArray[np.float32]:
        """Features at the start of the coming slot, shape (E, U, F)."""
        learning = self._learning
        return self.simulator.features(
            self.multipliers,
            observe_robots=learning.observe_robots,
            observe_demand=learning.observe_demand,
        )

    def run(self, policy: Weigher, record: SlotRecord) -> None:
        """Run as many slots as the record has under a compiled policy."""
        self.simulator.run(policy, multipliers=self.multipliers, record=record)

    def step(self, actions: NDArray[np.floating]) -> NDArray[np.float32]:
        """Run one slot under actions (E, U), to be found in `record`; returns the next features.

        ValueError if the actions have another shape, or one is outside [-1, 1] or not a number;
        ResetNeeded past the end of an episode.
        """
        if self.finished:
            slots = self.simulator.num_slots
            raise ResetNeeded(f"step: the episode of {slots} slots is over: call reset")
        wanted = self.simulator.state.weight.shape
        actions = np.asarray(actions)
        if actions.dtype.kind not in "fiu":
            raise ValueError(f"actions: of type {actions.dtype}, must be real numbers")
        if np.shape(actions) != wanted:
            raise ValueError(
                f"actions: shape {np.shape(actions)}, must be {wanted}: a number for every user of "
                "every world"
            )
        # One comparison that is false for NaN too.
        if not (np.abs(actions) <= 1.0).all():
            raise ValueError("actions: must lie in [-1, 1]")
        learning = self._learning
        control = None
        if learning.reward_terms == "control_drift":  # of what is known when the slot begins
            control = control_weights(self.simulator)
        self.simulator.run(
            learning.start,
            1,
            weights=action_weights(actions, learning.weight_exponent),
            weighs=learning.weighs,
            multipliers=self.multipliers,
            record=self.record,
        )
        self.task_costs = task_costs(self.record, learning)
        if control is not None:
            urllc = np.s_[:, : control.shape[1]]
            after = self.simulator.state.backlog_packets[urllc]
            drift = 0.5 * (after**2 - self.record.backlog_packets[:, 0][urllc] ** 2)
            self.task_costs += (control - 1.0) * drift / learning.reward_scale
        if self._pictures is not None:
            self._pictures.add(self.record, self.task_costs)
        return self.features()


def _pictures(simulator: Simulator, render_mode: str) -> Pictures:
    if render_mode not in RENDER_MODES:
        raise ValueError(
            f"render_mode = {render_mode!r}: must be {', '.join(RENDER_MODES)} or None"
        )
    with naming_extras():
        from hiersched.env.picture import Pictures
    return Pictures(simulator.scenario, simulator.num_envs, simulator.num_slots)
