"""A trained policy as a value: both actors of one seed, and what they may run on."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from hiersched.env.core import action_weights
from hiersched.env.features import FEATURE_VERSION, FEATURES, num_features, user_features
from hiersched.learning.networks import NETWORKS, Slices
from hiersched.simulator import Simulator, SlotRecord

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
class Policy:
    """Both actors of one seed after training.

    Attributes
    ----------
    parameters
        Of the URLLC and the eMBB actor, shape (2, P), float32.
    network, hidden
        Which network (``shared`` or ``mlp``), and its hidden layers.
    start
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
    start: str
    observe_robots: bool
    weight_exponent: float
    num_embb: int
    multipliers: NDArray[np.float64]
    seed: int
    scenario_sha256: str
    feature_version: int = FEATURE_VERSION

    def act(self, features: NDArray[np.float32]) -> NDArray[np.float64]:
        """Weights, shape (E, U), from features (E, U, F); without noise.

        The slices are told apart by the number of multipliers: one for each URLLC user.

        Raises
        ------
        ValueError
            If an ``mlp`` was trained on other numbers of users.
        """
        num_urllc = len(self.multipliers)
        slices = Slices(num_urllc, features.shape[1] - num_urllc)
        network = NETWORKS[self.network](slices, num_features(self.observe_robots), self.hidden)
        if self.network == "mlp" and slices.num_embb != self.num_embb:
            raise ValueError(
                f"features of {slices.num_embb} eMBB users: must be of {self.num_embb}, on which "
                "this mlp policy was trained"
            )
        with torch.no_grad():
            inputs = network.inputs(torch.from_numpy(features).unsqueeze(0))
            outputs = network.actor.forward(torch.from_numpy(self.parameters), inputs)
            actions: NDArray[np.float32] = network.raw_actions(outputs, 1).tanh()[0].numpy()
        return action_weights(actions, self.weight_exponent)

    def observe(
        self, simulator: Simulator, multipliers: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Features (E, U, F) of this policy's kind, under multipliers (E, R)."""
        return user_features(simulator, multipliers, observe_robots=self.observe_robots)

    def save(self, path: str | Path) -> None:
        """Write the policy to `path`; the file appears whole or not at all."""
        part = Path(f"{path}.part")
        saved = {
            "format": _FORMAT,
            "parameters": torch.from_numpy(self.parameters),
            "network": self.network,
            "hidden": list(self.hidden),
            "start": self.start,
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
    def load(cls, path: str | Path) -> Policy:
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
            start=saved["start"],
            observe_robots=saved["observe_robots"],
            weight_exponent=saved["weight_exponent"],
            num_embb=saved["num_embb"],
            multipliers=saved["multipliers"].numpy(),
            seed=saved["seed"],
            scenario_sha256=saved["scenario_sha256"],
            feature_version=saved["feature_version"],
        )

    def for_users(self, num_urllc: int) -> Policy:
        """Take the policy to `num_urllc` URLLC users: each observes the mean multiplier.

        Raises
        ------
        ValueError
            If it is an ``mlp`` of another number: its inputs are the users themselves.
        """
        if self.network == "mlp" and num_urllc != len(self.multipliers):
            raise ValueError(
                f"num_urllc = {num_urllc}: must be {len(self.multipliers)}, on which this mlp "
                "policy was trained (a shared one runs on any number)"
            )
        multipliers = np.full(num_urllc, self.multipliers.mean())
        return Policy(**{**vars(self), "multipliers": multipliers})


def rollout(
    simulator: Simulator,
    policy: Policy,
    num_slots: int | None = None,
    *,
    record: SlotRecord | None = None,
    on_slot: Callable[[int], None] | None = None,
) -> SlotRecord:
    """Run all worlds of a simulator under a policy, without noise and with its multipliers frozen.

    Parameters
    ----------
    simulator
        Worlds at any slot; they move on.
    policy
        What decides.
    num_slots
        Slots to run; up to the horizon unless given.
    record
        Record of `num_slots` slots to fill; a new one unless given.
    on_slot
        Is told after every slot how many are done.

    Returns
    -------
    record
        All slots of all worlds.

    Raises
    ------
    ValueError
        If the policy is for another number of URLLC users.
    """
    num_urllc = simulator.scenario.users.num_urllc
    if len(policy.multipliers) != num_urllc:
        raise ValueError(
            f"policy for {len(policy.multipliers)} URLLC users: must be for {num_urllc} "
            "(Policy.for_users takes it there)"
        )
    slots = simulator.slots_left if num_slots is None else num_slots
    whole = simulator.new_record(slots) if record is None else record
    multipliers = np.broadcast_to(
        policy.multipliers, (simulator.num_envs, len(policy.multipliers))
    ).copy()
    one = simulator.new_record(1)
    with single_thread():
        for slot in range(slots):
            weights = policy.act(policy.observe(simulator, multipliers))
            simulator.run(policy.start, 1, weights=weights, multipliers=multipliers, record=one)
            copy_slot(one, whole, slot)
            if on_slot is not None:
                on_slot(slot + 1)
    return whole


def copy_slot(one: SlotRecord, whole: SlotRecord, slot: int) -> None:
    """Copy the only slot of `one` into slot `slot` of `whole`."""
    whole.rows[:, slot] = one.rows[:, 0]
