"""A trained policy as a value: both actors of one seed, and what they may run on."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from hiersched.core.faults import InputError
from hiersched.core.files import write_bytes
from hiersched.core.parameters import NonEmpty, NonNegative, Seed, read_strictly
from hiersched.core.sealed import SealError, seal_json, unseal_json
from hiersched.models.model import Setup
from hiersched.policies.features import FEATURE_VERSION, FEATURES, num_features
from hiersched.policies.learned import (
    NetworkWords,
    layer_sizes,
    network_words,
    num_parameters,
)
from hiersched.policies.policy import Weigher

FORMAT = "hiersched policy 4"
_FORMAT_3 = "hiersched policy 3"
_SINCE_FORMAT_4 = {"observe_demand": False, "weighs": "utility"}
"""What format 3 does not say, and what its policies do."""
_FLOAT32 = np.dtype("<f4")
_Users = Annotated[int, Field(ge=1, le=10_000)]


class PolicyError(InputError, ValueError):
    """A policy file that cannot be used: the message says what is wrong and what is allowed."""


@dataclass(frozen=True, kw_only=True)
class _Content:
    """What a policy file holds besides its format; `parameters` are bytes in base 64."""

    feature_version: int
    network: Literal["shared", "mlp", "linear"]
    hidden: Annotated[tuple[Annotated[int, Field(ge=1, le=10_000)], ...], Field(max_length=20)]
    rule: Literal["pf", "max_weight", "drift_plus_penalty"]
    weighs: Literal["utility", "drift"]
    observe_robots: bool
    observe_demand: bool
    weight_exponent: Annotated[float, Field(gt=0, le=20)]
    num_embb: _Users
    multipliers: Annotated[tuple[NonNegative, ...], NonEmpty]
    seed: Seed
    scenario_sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    parameters: str


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainedPolicy(Weigher):
    """Both actors of one seed after training; runs as a kernel, without noise."""

    parameters: NDArray[np.float32]  # (2, P) of the URLLC and the eMBB actor
    network: str  # ``shared``, ``mlp`` or ``linear``
    hidden: tuple[int, ...]  # its hidden layers
    rule: str  # the scheduler whose utilities, or drift, the weights multiply
    weighs: str  # ``utility`` or ``drift``: which of them
    observe_robots: bool  # whether the features of the robots are observed
    observe_demand: bool  # whether those of their tasks' demand are
    weight_exponent: float  # c of w = exp(c a)
    num_embb: int  # eMBB users in training; an ``mlp`` runs on no other number
    # (R,) of each URLLC user when training ended: what the policy observes from now on.
    multipliers: NDArray[np.float64]
    seed: int
    scenario_sha256: str

    def words(self, setup: Setup) -> NetworkWords:
        """As in `Weigher`; ValueError if the policy is for other numbers of users."""
        users = setup.scenario.users
        mine, theirs = (len(self.multipliers), self.num_embb), (users.num_urllc, users.num_embb)
        if mine != theirs:
            raise ValueError(
                f"policy for {mine[0]} URLLC and {mine[1]} eMBB users: must be for {theirs[0]} and "
                f"{theirs[1]} (`for_users` takes it there)"
            )
        return network_words(
            self.parameters,
            self.network,
            self.hidden,
            observe_robots=self.observe_robots,
            observe_demand=self.observe_demand,
            weight_exponent=self.weight_exponent,
            num_urllc=users.num_urllc,
            num_embb=users.num_embb,
        )

    def save(self, path: str | Path) -> None:
        """Write the policy to `path`; the file appears whole or not at all."""
        values = vars(self) | {
            "parameters": base64.b64encode(self.parameters.astype(_FLOAT32).tobytes()).decode(),
            "multipliers": self.multipliers.tolist(),
        }
        head = {"format": FORMAT, "feature_version": FEATURE_VERSION}
        write_bytes(Path(path), seal_json(head | values).encode())

    @classmethod
    def load(cls, path: str | Path) -> TrainedPolicy:
        """Read a policy that `save` wrote; errors are those of `from_bytes`, or of the system."""
        return cls.from_bytes(Path(path).read_bytes(), path)

    @classmethod
    def from_bytes(cls, data: bytes, origin: str | Path) -> TrainedPolicy:
        """Make the policy of the content of its file, from `origin`.

        PolicyError if it is damaged or no policy, or of features that this version does not
        compute.
        """
        try:
            document = unseal_json(data)
            found = document.pop("format", None)
            if found not in (_FORMAT_3, FORMAT):
                raise SealError(f"its format is another than {FORMAT!r} or {_FORMAT_3!r}")
            if found == _FORMAT_3:
                document = _SINCE_FORMAT_4 | document
            content = read_strictly(_Content, document)
            if content.feature_version != FEATURE_VERSION:
                raise SealError(
                    f"feature_version = {content.feature_version}: must be {FEATURE_VERSION} "
                    f"({', '.join(FEATURES)})"
                )
            parameters = np.frombuffer(
                base64.b64decode(content.parameters, validate=True), _FLOAT32
            )
            actors = _actors(parameters, content)
            if content.weighs == "drift" and content.rule != "drift_plus_penalty":
                raise SealError(f"weighs = 'drift': must be 'utility' with rule = {content.rule!r}")
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(map(str, first["loc"]))
            raise PolicyError(f"{origin}: not a policy: {place}: {first['msg']}") from error
        except ValueError as error:
            raise PolicyError(f"{origin}: not a policy: {error}") from error
        kept = {field.name: getattr(content, field.name) for field in fields(content)}
        del kept["feature_version"]
        return cls(**kept | {"parameters": actors, "multipliers": np.array(content.multipliers)})

    def for_users(self, num_urllc: int, num_embb: int) -> TrainedPolicy:
        """Take the policy to other numbers of users: each URLLC user observes the mean multiplier.

        ValueError if it is an ``mlp`` of other numbers: its inputs are the users themselves.
        """
        mine = len(self.multipliers), self.num_embb
        if mine == (num_urllc, num_embb):
            return self
        if self.network == "mlp":
            raise ValueError(
                f"{num_urllc} URLLC and {num_embb} eMBB users: must be {mine[0]} and {mine[1]}, on "
                "which this mlp policy was trained (shared and linear ones run on any number)"
            )
        multipliers = self.multipliers
        if num_urllc != len(multipliers):
            multipliers = np.full(num_urllc, multipliers.mean())
        return replace(self, multipliers=multipliers, num_embb=num_embb)


def _actors(parameters: NDArray[np.float32], content: _Content) -> NDArray[np.float32]:
    """Return the parameters as (2, P); ValueError if they are others than the networks have."""
    sizes = layer_sizes(
        content.network,
        content.hidden,
        num_features(content.observe_robots, content.observe_demand),
        len(content.multipliers),
        content.num_embb,
    )
    wanted = 2, num_parameters(sizes)
    if parameters.size != math.prod(wanted):
        raise ValueError(
            f"{parameters.size} parameters: must be {wanted[0]} x {wanted[1]} (layers {sizes})"
        )
    if not np.isfinite(parameters).all():
        raise ValueError("its parameters are not all finite")
    return parameters.astype(np.float32).reshape(wanted)
