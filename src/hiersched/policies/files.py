"""Policies that other libraries have trained, by the files that they have written.

An entry of `policies` names the file, what its actions are of, and what it observes: what it does
not say is as in the section `learning`, whose environment is that of `hiersched.env`. The scenario
also holds the hash of every file: a run is of that content, wherever the file lies.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from hiersched.core.faults import InputError
from hiersched.core.parameters import STRICT
from hiersched.policies.features import num_features
from hiersched.policies.policy import Agent, Weights

if TYPE_CHECKING:
    from hiersched.scenario.schema import Scenario

ROWS = 16
"""Worlds that a network is asked for at once; rows without one are 0.

The bits of a matrix product depend on its number of rows, so that number is always the same: a
world has the same bits in every batch.
"""
CONVENTIONS = {
    "rule": "start",
    "weighs": "weighs",
    "weight_exponent": "weight_exponent",
    "observe_robots": "observe_robots",
    "observe_demand": "observe_demand",
}
"""Keys of an entry that the section `learning` fills in -> their names there."""

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class PolicyFileError(InputError, ValueError):
    """A file of a policy that cannot be used: the message says which key, what, what is allowed."""


class Spaces(NamedTuple):
    """Shapes of a world's observation and action; None for a length that may be any."""

    observation: tuple[int | None, ...]
    action: tuple[int | None, ...]


@dataclass(frozen=True, kw_only=True)
class FilePolicy:
    """What every policy in a file has: by which conventions of the environments it acts."""

    __pydantic_config__ = STRICT
    file_keys: ClassVar[tuple[str, ...]]
    """Keys that name files, the policy's own first; the hash of each is ``<key>_sha256``."""
    package: ClassVar[str]
    """What is imported to run it."""

    rule: Literal["pf", "max_weight", "drift_plus_penalty"]
    weighs: Literal["utility", "drift"]
    weight_exponent: Annotated[float, Field(gt=0, le=20)]
    observe_robots: bool
    observe_demand: bool

    @property
    def files(self) -> dict[str, tuple[str, str]]:
        """Key -> name and hash of each file that is named."""
        named = {key: getattr(self, key) for key in self.file_keys}
        return {
            key: (name, getattr(self, f"{key}_sha256"))
            for key, name in named.items()
            if name is not None
        }

    @property
    def metadata(self) -> dict[str, str]:
        """What logs say of it, besides the scenario: files, and of what the weights are."""
        said: dict[str, str] = {"start": self.rule, "weighs": self.weighs}
        for key, (name, sha256) in self.files.items():
            said |= {f"policy_{key}": name, f"policy_{key}_sha256": sha256}
        return said

    def faults(self, scenario: Scenario) -> list[str]:
        """Name what does not fit the rest of the scenario, as ``key = value: …``."""
        faults = []
        if self.weighs == "drift" and self.rule != "drift_plus_penalty":
            faults.append(
                f"weighs = drift: must be utility with rule = {self.rule}, which has no drift"
            )
        for key in ("observe_robots", "observe_demand"):
            if getattr(self, key) and not scenario.plant.has_pose:
                faults.append(
                    f"{key} = true: must be false where plant.model = {scenario.plant.model}, "
                    "whose robots have no position"
                )
        return faults

    def shape_faults(self, spaces: Spaces, scenario: Scenario) -> list[str]:
        """Say where the spaces of its file are not those of the scenario's environment."""
        users = scenario.num_users
        features = num_features(self.observe_robots, self.observe_demand)
        wanted = ((users, features), (users * features,)), ((users,),)
        key = self.file_keys[0]
        return [
            f"{key} = {getattr(self, key)!r}: {kind} of shape {_shape_text(shape)}: must be "
            f"{' or '.join(map(_shape_text, allowed))} ({users} users, {features} features of each)"
            for kind, shape, allowed in zip(Spaces._fields, spaces, wanted, strict=True)
            if not any(_fits(shape, one) for one in allowed)
        ]


@dataclass(frozen=True, kw_only=True)
class Sb3Policy(FilePolicy):
    """A model that stable-baselines3 has saved, `algorithm` the class that has saved it.

    `vec_normalize` is what `VecNormalize.save` has written: observations are normalised by it.
    """

    file_keys = ("sb3", "vec_normalize")
    package = "stable_baselines3"
    sb3: str
    algorithm: Literal["a2c", "ddpg", "ppo", "sac", "td3"] = "ppo"
    vec_normalize: str | None = None
    sb3_sha256: Sha256
    vec_normalize_sha256: Sha256 | None = None


@dataclass(frozen=True, kw_only=True)
class OnnxPolicy(FilePolicy):
    """A graph in ONNX: one input, the observations; its first output are the actions."""

    file_keys = ("onnx",)
    package = "onnxruntime"
    onnx: str
    onnx_sha256: Sha256


FILE_POLICIES: dict[str, type[FilePolicy]] = {"sb3": Sb3Policy, "onnx": OnnxPolicy}
"""Key by which an entry of `policies` is known -> its class."""


class FileAgent(Agent):
    """A policy in a file that runs in worlds of one scenario.

    PolicyFileError if the file's spaces are not those of the scenario.
    """

    def __init__(self, entry: FilePolicy, spaces: Spaces, scenario: Scenario) -> None:
        if faults := entry.shape_faults(spaces, scenario):
            raise PolicyFileError("; ".join(faults))
        key = entry.file_keys[0]
        self.name = f"{key} = {getattr(entry, key)!r}"
        self.rule, self.weighs = entry.rule, entry.weighs
        self.weight_exponent = entry.weight_exponent
        self.observe_robots, self.observe_demand = entry.observe_robots, entry.observe_demand
        self.rows = ROWS
        self._is_flat = len(spaces.observation) == 1

    def predict(self, observations: NDArray[np.float32]) -> NDArray[np.floating]:
        """Return actions (rows, U) of observations (rows, …), as the policy's spaces have them."""
        raise NotImplementedError

    def weights(self, features: NDArray[np.float32]) -> Weights:
        """As in `Agent`, but that the error is a PolicyFileError."""
        try:
            return super().weights(features)
        except ValueError as error:
            raise PolicyFileError(str(error)) from error

    def act(self, features: NDArray[np.float32]) -> NDArray[np.floating]:
        """As in `Agent`."""
        count = len(features)
        padded = np.zeros((-(-count // self.rows) * self.rows, *features.shape[1:]), np.float32)
        padded[:count] = features
        if self._is_flat:
            padded = padded.reshape(len(padded), -1)
        parts = [
            self.predict(padded[first : first + self.rows]) for first in range(0, count, self.rows)
        ]
        return np.concatenate(parts)[:count]


_found: dict[str, Path] = {}
"""Hash of a file -> where it was when a scenario that names it was read."""


def note_file(path: Path) -> str:
    """Return the SHA-256 of a file, and remember where it lies; errors are the system's."""
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    _found[sha256] = path.resolve()
    return sha256


def read_file(entry: FilePolicy, key: str) -> bytes:
    """Return the content of a file of a policy: that of the scenario's hash, and no other.

    It is looked for where it was when the scenario was read, and in the working directory, whence
    logs are replayed. PolicyFileError if it is not there.
    """
    name, sha256 = entry.files[key]
    places = dict.fromkeys((_found.get(sha256, Path(name)), Path(name)))
    for path in places:
        if path.is_file():
            content = path.read_bytes()
            if hashlib.sha256(content).hexdigest() == sha256:
                return content
    raise PolicyFileError(
        f"{key} = {name!r}: no such file with the SHA-256 {sha256}; looked at "
        f"{', '.join(map(str, places))}"
    )


def _fits(shape: Sequence[int | None], wanted: tuple[int, ...]) -> bool:
    return len(shape) == len(wanted) and all(
        length in (None, one) for length, one in zip(shape, wanted, strict=True)
    )


def _shape_text(shape: Sequence[int | None]) -> str:
    lengths = ["any" if length is None else str(length) for length in shape]
    return f"({', '.join(lengths)}{',' * (len(lengths) == 1)})"
