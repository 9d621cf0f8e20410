"""A trained policy as a value: both actors of one seed, and what they may run on."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from hiersched.models.model import Setup
from hiersched.policies.features import FEATURE_VERSION, FEATURES
from hiersched.policies.learned import FlatWords, SharedWords, network_words
from hiersched.policies.policy import Weigher

_FORMAT = 2


class PolicyError(ValueError):
    """A policy file that cannot be used: the message says what is wrong and what is allowed."""


@contextmanager
def single_thread() -> Iterator[None]:
    """One torch thread within: the bits of a matrix product depend on the number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainedPolicy(Weigher):
    """Both actors of one seed after training; runs as a kernel, without noise.

    Attributes
    ----------
    parameters
        Of the URLLC and the eMBB actor, shape (2, P), float32.
    network, hidden
        Which network (``shared`` or ``mlp``), and its hidden layers.
    rule
        The scheduler whose utilities the weights multiply.
    observe_robots
        Whether the features of the robots are observed.
    num_embb
        eMBB users in training; an ``mlp`` runs on no other number.
    weight_exponent
        c of w = exp(c a).
    multipliers
        Multiplier of each URLLC user when training ended, shape (R,): what the policy observes from
        now on.
    seed, scenario_sha256, feature_version
        Where the policy comes from.
    """

    parameters: NDArray[np.float32]
    network: str
    hidden: tuple[int, ...]
    rule: str
    observe_robots: bool
    weight_exponent: float
    num_embb: int
    multipliers: NDArray[np.float64]
    seed: int
    scenario_sha256: str
    feature_version: int = FEATURE_VERSION

    def words(self, setup: Setup) -> SharedWords | FlatWords:
        """As in `Weigher`.

        Raises
        ------
        ValueError
            If the policy is for other numbers of users.
        """
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
            weight_exponent=self.weight_exponent,
            num_urllc=users.num_urllc,
            num_embb=users.num_embb,
        )

    def save(self, path: str | Path) -> None:
        """Write the policy to `path`; the file appears whole or not at all."""
        part = Path(f"{path}.part")
        saved = {
            "format": _FORMAT,
            "parameters": torch.from_numpy(self.parameters),
            "network": self.network,
            "hidden": list(self.hidden),
            "start": self.rule,
            "observe_robots": self.observe_robots,
            "weight_exponent": self.weight_exponent,
            "num_embb": self.num_embb,
            "multipliers": torch.from_numpy(self.multipliers),
            "seed": self.seed,
            "scenario_sha256": self.scenario_sha256,
            "feature_version": self.feature_version,
        }
        torch.save(saved, part)
        os.replace(part, path)

    @classmethod
    def load(cls, path: str | Path) -> TrainedPolicy:
        """Read a policy that `save` wrote.

        Raises
        ------
        PolicyError
            If the file is none, or of features that this version does not compute.
        """
        try:
            saved = torch.load(path, weights_only=True)
        except FileNotFoundError:
            raise
        except Exception as error:
            raise PolicyError(f"{path}: not a policy file: {error}") from error
        if not isinstance(saved, dict) or saved.get("format") != _FORMAT:
            raise PolicyError(f"{path}: not a policy file of format {_FORMAT}")
        if saved["feature_version"] != FEATURE_VERSION:
            raise PolicyError(
                f"{path}: feature_version = {saved['feature_version']}: must be {FEATURE_VERSION} "
                f"({', '.join(FEATURES)})"
            )
        return cls(
            parameters=saved["parameters"].numpy(),
            network=saved["network"],
            hidden=tuple(saved["hidden"]),
            rule=saved["start"],
            observe_robots=saved["observe_robots"],
            weight_exponent=saved["weight_exponent"],
            num_embb=saved["num_embb"],
            multipliers=saved["multipliers"].numpy(),
            seed=saved["seed"],
            scenario_sha256=saved["scenario_sha256"],
            feature_version=saved["feature_version"],
        )

    def for_users(self, num_urllc: int, num_embb: int) -> TrainedPolicy:
        """Take the policy to other numbers of users: each URLLC user observes the mean multiplier.

        Raises
        ------
        ValueError
            If it is an ``mlp`` of other numbers: its inputs are the users themselves.
        """
        mine = len(self.multipliers), self.num_embb
        if mine == (num_urllc, num_embb):
            return self
        if self.network == "mlp":
            raise ValueError(
                f"{num_urllc} URLLC and {num_embb} eMBB users: must be {mine[0]} and {mine[1]}, on "
                "which this mlp policy was trained (a shared one runs on any number)"
            )
        multipliers = self.multipliers
        if num_urllc != len(multipliers):
            multipliers = np.full(num_urllc, multipliers.mean())
        return replace(self, multipliers=multipliers, num_embb=num_embb)
