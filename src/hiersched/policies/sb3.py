"""Policies that stable-baselines3 has trained.

Its files hold pickled objects: to load one runs code that is in it. What a scenario's check reads
of it, its spaces, is JSON.
"""

from __future__ import annotations

import io
import json
import pickle
import zipfile
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hiersched.core.extras import naming_extras
from hiersched.policies.files import FileAgent, PolicyFileError, Sb3Policy, Spaces, read_file

if TYPE_CHECKING:
    from hiersched.scenario.schema import Scenario


@lru_cache(maxsize=8)
def read_spaces(entry: Sb3Policy) -> Spaces:
    """Read the spaces of a saved model; no object in it is unpickled.

    PolicyFileError if it is no saved model, or its spaces are no boxes, or actions not [-1, 1].
    """
    where = f"sb3 = {entry.sb3!r}"
    try:
        with zipfile.ZipFile(io.BytesIO(read_file(entry, "sb3"))) as archive:
            data = json.loads(archive.read("data"))
        found = [data[name] for name in ("observation_space", "action_space")]
        for space in found:
            if not space[":type:"].endswith("gymnasium.spaces.box.Box'>"):
                raise PolicyFileError(f"{where}: a space {space[':type:']}: must be a Box")
        observation, action = (tuple(map(int, space["_shape"])) for space in found)
        bounds = [_numbers(found[1][name]) for name in ("low", "high")]
    except (zipfile.BadZipFile, ValueError, LookupError, TypeError, AttributeError) as error:
        if isinstance(error, PolicyFileError):
            raise
        raise PolicyFileError(
            f"{where}: no model that stable-baselines3 has saved: {type(error).__name__}: {error}"
        ) from error
    if bounds != [{-1.0}, {1.0}]:
        raise PolicyFileError(f"{where}: actions between {bounds}: must be between -1 and 1")
    return Spaces(observation, action)


def _numbers(text: str) -> set[float]:
    """Numbers of an array as NumPy prints it; of a long one it leaves out the middle."""
    return {
        float(part) for part in text.replace("[", " ").replace("]", " ").split() if part != "..."
    }


class Sb3Agent(FileAgent):
    """A saved model that decides, without noise, in worlds of one scenario."""

    def __init__(self, entry: Sb3Policy, scenario: Scenario) -> None:
        self._spaces = read_spaces(entry)
        super().__init__(entry, self._spaces, scenario)
        with naming_extras():
            import stable_baselines3
        kind = getattr(stable_baselines3, entry.algorithm.upper())
        more = {"buffer_size": 1} if hasattr(kind, "load_replay_buffer") else {}
        content = io.BytesIO(read_file(entry, "sb3"))
        try:
            self._model = kind.load(content, device="cpu", **more)
        except Exception as error:  # whatever the objects in it do
            raise PolicyFileError(
                f"{self.name}: cannot be loaded with algorithm = {entry.algorithm!r}: "
                f"{type(error).__name__}: {error}"
            ) from error
        self._normalize = self._statistics(entry)

    def _statistics(self, entry: Sb3Policy) -> Any:
        """Load what observations are normalised by; None where they are not."""
        if entry.vec_normalize is None:
            return None
        from stable_baselines3.common.vec_env import VecNormalize

        where = f"vec_normalize = {entry.vec_normalize!r}"
        try:
            found = pickle.loads(read_file(entry, "vec_normalize"))
        except PolicyFileError:
            raise
        except Exception as error:
            raise PolicyFileError(
                f"{where}: cannot be loaded: {type(error).__name__}: {error}"
            ) from error
        if not isinstance(found, VecNormalize):
            raise PolicyFileError(f"{where}: a {type(found).__name__}: must be a VecNormalize")
        shape, wanted = found.observation_space.shape, self._spaces.observation
        if shape != wanted:
            raise PolicyFileError(
                f"{where}: of observations of shape {shape}: must be {wanted}, as the model's"
            )
        return found

    def predict(self, observations: NDArray[np.float32]) -> NDArray[np.floating]:
        """As in `FileAgent`."""
        if self._normalize is not None:
            observations = self._normalize.normalize_obs(observations)
        actions, _ = self._model.predict(observations, deterministic=True)
        return np.asarray(actions)
