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
    """Both actors of one seed after training; runs as a kernel, without noise."""

    parameters: NDArray[np.float32]  # (2, P) of the URLLC and the eMBB actor
    network: str  # ``shared`` or ``mlp``
    hidden: tuple[int, ...]  # its hidden layers
    rule: str  # the scheduler whose utilities the weights multiply
    observe_robots: bool  # whether the features of the robots are observed
    weight_exponent: float  # c of w = exp(c a)
    num_embb: int  # eMBB users in training; an ``mlp`` runs on no other number
    # (R,) of each URLLC user when training ended: what the policy observes from now on.
    multipliers: NDArray[np.float64]
    seed: int
    scenario_sha256: str

    def words(self, setup: Setup) -> SharedWords | FlatWords:
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
            weight_exponent=self.weight_exponent,
            num_urllc=users.num_urllc,
            num_embb=users.num_embb,
        )

    def save(self, path: str | Path) -> None:
        """Write the policy to `path`; the file appears whole or not at all."""
        saved = {
            name: torch.from_numpy(value) if isinstance(value, np.ndarray) else value
            for name, value in vars(self).items()
        }
        saved["start"] = saved.pop("rule")
        part = Path(f"{path}.part")
        torch.save({"format": _FORMAT, "feature_version": FEATURE_VERSION, **saved}, part)
        os.replace(part, path)

    @classmethod
    def load(cls, path: str | Path) -> TrainedPolicy:
        """Read a policy that `save` wrote.

        PolicyError if the file is none, or of features that this version does not compute.
        """
        try:
            saved = torch.load(path, weights_only=True)
        except FileNotFoundError:
            raise
        except Exception as error:
            raise PolicyError(f"{path}: not a policy file: {error}") from error
        if not isinstance(saved, dict) or saved.pop("format", None) != _FORMAT:
            raise PolicyError(f"{path}: not a policy file of format {_FORMAT}")
        version = saved.pop("feature_version")
        if version != FEATURE_VERSION:
            raise PolicyError(
                f"{path}: feature_version = {version}: must be {FEATURE_VERSION} "
                f"({', '.join(FEATURES)})"
            )
        arrays = {name: saved.pop(name).numpy() for name in ("parameters", "multipliers")}
        return cls(rule=saved.pop("start"), hidden=tuple(saved.pop("hidden")), **arrays, **saved)

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
                "which this mlp policy was trained (a shared one runs on any number)"
            )
        multipliers = self.multipliers
        if num_urllc != len(multipliers):
            multipliers = np.full(num_urllc, multipliers.mean())
        return replace(self, multipliers=multipliers, num_embb=num_embb)
