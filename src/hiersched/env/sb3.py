"""The native batch as a vector environment of stable-baselines3."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from hiersched.env.vector import SlicingVectorEnv
from hiersched.scenario.schema import Scenario
from hiersched.simulator import Gains

Indices = int | Iterable[int] | None


class SlicingVecEnv(VecEnv):
    """E worlds of a `SlicingVectorEnv`; spaces, rewards and infos are those of `SlicingEnv`.

    The parameters are those of `SlicingVectorEnv`, whose mode is always ``SameStep``: the next
    episode begins in the step that ends one, and the last observation is in the infos under
    ``terminal_observation``. `VecMonitor` around it writes down the returns of episodes. After
    ``seed(s)`` the next reset begins with the first E worlds of seed s.
    """

    _actions: NDArray[np.floating]

    def __init__(
        self,
        scenario: Scenario | str | Path,
        gains: Gains | None = None,
        num_envs: int = 1,
        *,
        num_slots: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        self._batch = SlicingVectorEnv(
            scenario, gains, num_envs, num_slots=num_slots, render_mode=render_mode
        )
        spaces = self._batch.single_observation_space, self._batch.single_action_space
        super().__init__(num_envs, *spaces)
        self.metadata = self._batch.metadata

    def reset(self) -> NDArray[np.float32]:
        """Start an episode in new worlds; returns features (E, U, F)."""
        observation, _ = self._batch.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: NDArray[np.floating]) -> None:
        """Keep the actions of all worlds, shape (E, U), for `step_wait`."""
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Run one slot of all worlds."""
        observation, reward, _, done, info = self._batch.step(self._actions)
        final = info.get("final_obs")
        infos = _rows(info if final is None else info["final_info"])
        for row in infos:
            row["TimeLimit.truncated"] = final is not None
        if final is not None:
            for row, last in zip(infos, final, strict=True):
                row["terminal_observation"] = last
        return observation, reward.astype(np.float32), done, infos

    def close(self) -> None:
        """Close the batch."""
        self._batch.close()

    def get_images(self) -> list[NDArray[np.uint8] | None]:
        """Draw every world; `render` tiles the pictures."""
        frames = self._batch.render()
        return [None] * self.num_envs if frames is None else list(frames)

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute of the batch, once for each world asked for."""
        return [getattr(self._batch, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of the batch; ValueError if not all worlds are asked for."""
        self._require_all(f"set_attr({attr_name!r})", indices)
        setattr(self._batch, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the batch once; its result stands for every world.

        ValueError if not all worlds are asked for.
        """
        self._require_all(f"env_method({method_name!r})", indices)
        result = getattr(self._batch, method_name)(*method_args, **method_kwargs)
        return [result] * self.num_envs

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper], indices: Indices = None
    ) -> list[bool]:
        """Say for each world asked for that no wrapper is around it alone."""
        return [False for _ in self._get_indices(indices)]

    def _require_all(self, call: str, indices: Indices) -> None:
        if sorted(self._get_indices(indices)) != list(range(self.num_envs)):
            raise ValueError(f"{call}: worlds {indices}, must be all: they are one environment")


def _rows(info: dict[str, Any]) -> list[dict[str, Any]]:
    """Turn entries with leading axis (E,) into one dictionary a world."""
    names = [name for name in info if not name.startswith("_")]
    columns = [info[name] for name in names]
    lists = [column.tolist() if column.ndim == 1 else list(column) for column in columns]
    return [dict(zip(names, row, strict=True)) for row in zip(*lists, strict=True)]
