"""The simulator as a Gymnasium vector environment: a native batch, without one process a world."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.utils import EzPickle
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from hiersched.env.core import RENDER_MODES, EpisodeWorlds, SlotLoop, as_scenario
from hiersched.policies.features import num_features
from hiersched.scenario.schema import Scenario
from hiersched.simulator import Gains


def user_spaces(scenario: Scenario) -> tuple[spaces.Box, spaces.Box]:
    """Spaces of one world: features of every user, one number in [-1, 1] for each."""
    learning = scenario.learning
    width = num_features(learning.observe_robots, learning.observe_demand)
    return (
        spaces.Box(-np.inf, np.inf, (scenario.num_users, width), np.float32),
        spaces.Box(-1.0, 1.0, (scenario.num_users,), np.float32),
    )


def slot_info(loop: SlotLoop) -> dict[str, NDArray[Any]]:
    """Say what a slot cost, shape (E,) or (E, U) each; `cost` counts packets now late."""
    record, num_urllc = loop.record, loop.multipliers.shape[1]
    return {
        "cost": record.late_packets[:, 0, :num_urllc].sum(axis=-1).astype(np.float64),
        "due_packets": record.due_packets[:, 0, :num_urllc].sum(axis=-1).astype(np.float64),
        "reward_urllc": record.reward_urllc[:, 0] - loop.task_costs.mean(axis=1),
        "reward_embb": record.reward_embb[:, 0].copy(),
        # torch knows little of unsigned integers.
        "prb_count": record.num_prb[:, 0].astype(np.int64),
    }


def real_time(metadata: dict[str, Any], scenario: Scenario) -> dict[str, Any]:
    """Return metadata whose frame rate is that of the scenario's slots [1/s]."""
    return {**metadata, "render_fps": round(1.0 / scenario.radio.slot_s)}


class SlicingVectorEnv(EzPickle, VectorEnv):
    """E worlds side by side; one decision a slot for all users of both slices.

    Observation (E, U, F): `policies.features`. Action (E, U): one number in [-1, 1] for every
    user, the weight is exp(c a). Reward: mean of both slices' rewards; the parts and the cost are
    in the info. An episode ends at the slot limit only, which is truncation; all worlds end
    together. A copy, or one that was pickled, starts before the first reset.

    Parameters
    ----------
    scenario
        A scenario, the name of a shipped one, or a path.
    gains, num_slots, render_mode
        As for `SlotLoop`.
    num_envs
        E, the worlds.
    autoreset_mode
        One of Gymnasium's modes, or its name. ``SameStep``: the step that ends an episode begins
        the next one, and its last observation and info are in ``info["final_obs"]`` and
        ``info["final_info"]``. ``NextStep``: the step after it does, whatever the actions, with
        reward 0. ``Disabled``: `reset` does.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as the base class has it)
        "autoreset_mode": AutoresetMode.SAME_STEP,
        "render_modes": list(RENDER_MODES),
        "render_fps": 100,
    }

    def __init__(
        self,
        scenario: Scenario | str | Path,
        gains: Gains | None = None,
        num_envs: int = 1,
        *,
        num_slots: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        render_mode: str | None = None,
    ) -> None:
        options = {
            "num_slots": num_slots,
            "autoreset_mode": autoreset_mode,
            "render_mode": render_mode,
        }
        EzPickle.__init__(self, scenario, gains, num_envs, **options)
        scenario = as_scenario(scenario)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        self.metadata = {
            **real_time(self.metadata, scenario),
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_observation_space, self.single_action_space = user_spaces(scenario)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._worlds = EpisodeWorlds(num_envs)
        self._loop = SlotLoop(scenario, gains, self._worlds.coming(), num_slots, render_mode)

    @property
    def multipliers(self) -> NDArray[np.float64]:
        """Multipliers in force, shape (E, R); write into it to change them."""
        return self._loop.multipliers

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode in new worlds; with a seed, in the first worlds of that seed.

        ValueError if the option `reset_mask` leaves out a world: they end together.
        """
        super().reset(seed=seed)
        if options and not np.all(options.get("reset_mask", True)):
            raise ValueError("reset_mask: must be True for every world: all begin together")
        return self._loop.reset(self._worlds.take(seed)), {}

    def step(
        self, actions: NDArray[np.floating]
    ) -> tuple[
        NDArray[np.float32],
        NDArray[np.float64],
        NDArray[np.bool_],
        NDArray[np.bool_],
        dict[str, Any],
    ]:
        """Run one slot of all worlds, or begin their next episode (`autoreset_mode`)."""
        self._worlds.require_episode("step")
        terminated = np.zeros(self.num_envs, np.bool_)
        if self._loop.finished and self.autoreset_mode is AutoresetMode.NEXT_STEP:
            features = self._loop.reset(self._worlds.take())
            return features, np.zeros(self.num_envs), terminated, terminated.copy(), {}
        features = self._loop.step(actions)
        info = _masked(slot_info(self._loop), self.num_envs)
        reward = 0.5 * (info["reward_urllc"] + info["reward_embb"])
        truncated = np.full(self.num_envs, self._loop.finished)
        if self._loop.finished and self.autoreset_mode is AutoresetMode.SAME_STEP:
            # A plain array, as every world has one: NumpyToTorch knows no arrays of objects.
            info = _masked({"final_obs": features, "final_info": info}, self.num_envs)
            features = self._loop.reset(self._worlds.take())
        return features, reward, terminated, truncated, info

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Draw the last slots of every world, shape (height, width, 3) each."""
        self._worlds.require_episode("render")
        return self._loop.render()


def _autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        names = ", ".join(known.value for known in AutoresetMode)
        raise ValueError(f"autoreset_mode = {mode!r}: must be one of {names}") from None


def _masked(info: dict[str, Any], num_envs: int) -> dict[str, Any]:
    """Add to each entry which worlds have it: all of them."""
    return info | {f"_{name}": np.ones(num_envs, np.bool_) for name in info}
