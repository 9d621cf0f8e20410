"""A batch of worlds, and how a policy runs in it."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import numpy as np
from numba import typeof
from numpy.typing import NDArray

from hiersched.core.pointer import Pointer
from hiersched.core.seam import UNUSED, KernelError, Plug, Seam
from hiersched.models import seams
from hiersched.models.model import Model, Setup, models_of, num_model_values
from hiersched.policies.features import num_features, observe_worlds
from hiersched.policies.find import find_policy
from hiersched.policies.policy import (
    Agent,
    LoggedDecisions,
    Owners,
    Policy,
    View,
    Weigher,
    Weights,
)
from hiersched.policies.registry import ALLOCATIONS, Rule
from hiersched.policies.seams import ALLOCATE, INDEX, WEIGH
from hiersched.scenario import Scenario, kinds_of_robots
from hiersched.simulator.loop import (
    Plugs,
    decide_slots,
    draw_channels,
    rate_channels,
    run_robots,
    run_slots,
)
from hiersched.simulator.loop_gains import Gains
from hiersched.simulator.record import SlotLayout, SlotRecord
from hiersched.simulator.setup import (
    TASK_STATE,
    SlotConstants,
    SlotState,
    reset_state,
    slot_constants,
    slot_state,
)

AnyPolicy = str | Rule | Weigher | Policy | Agent | LoggedDecisions
"""Name of a rule, or a policy of one of the forms in `policies.policy`."""


class Simulator:
    """A batch of worlds that share one scenario, until `num_slots` slots have run.

    `keys`, shape (E,), are worlds from `randomness.world_key`. ValueError if gains and scenario do
    not fit.

    Attributes
    ----------
    constants, state
        Of the slot loop; the state's arrays stay the same objects and move on.
    models
        The scenario's models by their place in the loop, and `words`, what each of them is made of.
    view
        What policies in Python are shown.
    slot_in_work
        The memory in which the kernels form a slot, whose words go into the record.
    """

    def __init__(
        self, scenario: Scenario, gains: Gains, keys: NDArray[np.uint64], num_slots: int
    ) -> None:
        self.scenario = scenario
        self.num_slots = num_slots
        self.setup = Setup(
            scenario=scenario,
            num_envs=len(keys),
            num_slots=num_slots,
            kinds=kinds_of_robots(scenario),
        )
        self.models: dict[str, Model] = models_of(scenario)
        self.words = {name: model.words(self.setup) for name, model in self.models.items()}
        self.constants: SlotConstants = slot_constants(scenario, gains)
        self.state: SlotState = slot_state(self.setup, has_report=self.words["report"] is not None)
        self.view = _view(self.state, self.constants)
        self._layout = SlotLayout(
            scenario.num_users,
            scenario.users.num_urllc,
            scenario.radio.num_prb,
            scenario.robot_sizes,
            num_model_values(scenario),
        )
        self.slot_in_work = one = self._layout.slot()
        self._constants, self._state = Pointer(self.constants), Pointer(self.state)
        self._one, self._slot = Pointer(one), Pointer(one.fields)
        self._kept: list[Pointer] = []  # what lies behind the addresses in plugs
        self._plugs = Plugs(
            path_loss=self._plug_model(seams.MOVE_USERS, "path_loss", needed=False),
            fading=self._plug_model(seams.DRAW_FADING, "fading"),
            link=self._plug_model(seams.RATE_PRBS, "link"),
            report=self._plug_model(seams.REPORT, "report", needed=False),
            deliver=self._plug_model(seams.DELIVER, "link"),
            arrivals=self._plug_model(seams.OFFER, "arrivals"),
            queue=self._plug_model(seams.SERVE, "queue"),
            plant=self._plug_model(seams.DRIVE, "plant"),
        )
        self._models = Pointer(self._plugs)
        self._no_owners = np.zeros((0, 0, 0), np.uint32)
        self._prepared: dict[Hashable, Pointer] = {}
        self._policies: list[tuple[Rule | Weigher, Any]] = []  # compiled, and their words
        self._entries: dict[Any, Any] = {}
        self.reset(keys)

    def _plug(self, seam: Seam, model: Any, words: Any, *, needed: bool = True) -> Plug:
        """Plug words into a seam; UNUSED where there are none and the seam needs none."""
        if words is None:
            if needed:
                kind = type(model)
                raise KernelError(
                    f"{kind.__module__}.{kind.__qualname__}: its `words` returns None: must be the "
                    f"NamedTuple of its kernel for the seam {seam.name}"
                )
            return UNUSED
        plug, pointer = seam.plug(words, self._constants, self._state, self._slot)
        self._kept.append(pointer)
        return plug

    def _plug_model(self, seam: Seam, name: str, *, needed: bool = True) -> Plug:
        return self._plug(seam, self.models[name], self.words[name], needed=needed)

    def _plug_policy(self, seam: Seam, policy: Rule | Weigher, *, needed: bool = True) -> Plug:
        words = policy.words(self.setup)
        plug = self._plug(seam, policy, words, needed=needed)
        if words is not None:
            self._policies.append((policy, words))
            policy.reset(words, self.state.key)
        return plug

    def _call(self, kernel: Any, *arguments: Any) -> None:
        """Call a kernel, compiled for what it is given the first time.

        A dispatcher looks at the type of every argument in every call, which takes longer than a
        slot.
        """
        if kernel not in self._entries:
            self._entries[kernel] = kernel.compile(tuple(map(typeof, arguments)))
        self._entries[kernel](*arguments)

    @property
    def num_envs(self) -> int:
        """Worlds in the batch."""
        return self.setup.num_envs

    @property
    def slots_left(self) -> int:
        """Slots until the horizon."""
        return self.num_slots - int(self.state.slot.max())

    def reset(self, keys: NDArray[np.uint64]) -> None:
        """Start anew in the worlds `keys`, shape (E,); ValueError if their number differs."""
        if len(keys) != self.num_envs:
            raise ValueError(f"{len(keys)} worlds, must be {self.num_envs}")
        keys = np.array(keys, np.uint64)
        reset_state(self.state, self.scenario, keys)
        parts = [(model, self.words[name]) for name, model in self.models.items()]
        for model, words in (*parts, *self._policies):
            if words is not None:
                model.reset(words, keys)
        self._call(draw_channels, self._models, self._constants, self._state, self._slot)

    def run(
        self,
        policy: AnyPolicy,
        num_slots: int | None = None,
        *,
        weights: NDArray[np.float64] | None = None,
        weighs: str = "utility",
        multipliers: NDArray[np.float64] | None = None,
        record: SlotRecord | None = None,
    ) -> SlotRecord:
        """Run all worlds under a policy: the name of one, or one of any form.

        It runs `num_slots` slots; unless given those of the decisions or of the record, or up to
        the horizon. `record` is filled and returned; a new one unless given. `weights` (E, U) are
        factors of the users' utilities under a rule, held for all these slots, 1 unless given;
        round robin and EDF have no utility and leave them unused. With `weighs` = ``drift``, which
        drift-plus-penalty has, they are factors of its drift. `multipliers` (E, R) are those of
        each URLLC user's delay constraint; those of the policy unless given, or 0.

        ValueError on an unknown policy, weights that are not positive and finite, owners that are
        not there or leave a user without a PRB, or slots beyond the horizon.
        """
        if isinstance(policy, str):
            policy = find_policy(self.scenario, policy)
        if weighs != "utility" and not isinstance(policy, Rule):
            raise ValueError(f"weighs = {weighs!r}: must be utility for all policies but rules")
        if num_slots is None:
            num_slots = self._slots_of(policy, record)
        record = self._record(num_slots, record)
        self._set(policy, weights, multipliers)
        if isinstance(policy, LoggedDecisions):
            self._run(None, record, self._owners(policy.prb_owner, num_slots))
        elif isinstance(policy, (Rule, Weigher)):  # a union is made anew in every call
            self._run(policy, record, weighs=weighs)
        elif isinstance(policy, (Agent, Policy)):
            self._by_slot(policy, record)
        else:
            raise ValueError(f"policy = {policy!r}: neither a rule nor has it `decide(view)`")
        return record

    def rule(self, name: str) -> Rule:
        """Return a rule as it runs under its own name; ValueError if there is none."""
        rule = find_policy(self.scenario, name)
        if not isinstance(rule, Rule):
            raise ValueError(f"rule = {name!r}: a policy that calls Python, not a compiled rule")
        return rule

    def _slots_of(self, policy: AnyPolicy, record: SlotRecord | None) -> int:
        if record is not None:
            return int(record.prb_owner.shape[1])
        if isinstance(policy, LoggedDecisions):
            if policy.prb_owner.ndim != 3:
                raise ValueError(
                    f"prb_owner: shape {policy.prb_owner.shape}, must be "
                    f"({self.num_envs}, slots, {self.scenario.radio.num_prb})"
                )
            return int(policy.prb_owner.shape[1])
        return self.slots_left

    def _set(
        self,
        policy: AnyPolicy,
        weights: NDArray[np.float64] | None,
        multipliers: NDArray[np.float64] | None,
    ) -> None:
        """Put weights and multipliers into the state."""
        if weights is None:
            self.state.weight[:] = 1.0
        else:
            self._set_weights(weights)
        if multipliers is None:
            multipliers = getattr(policy, "multipliers", None)
        if multipliers is not None and multipliers.shape[-1] != self.state.multiplier.shape[1]:
            raise ValueError(
                f"multipliers of {multipliers.shape[-1]} URLLC users: must be of "
                f"{self.state.multiplier.shape[1]}"
            )
        self.state.multiplier[:] = 0.0 if multipliers is None else multipliers

    def _set_weights(self, weights: NDArray[np.float64]) -> None:
        shape = self.state.weight.shape
        wanted = f"weights: must be positive and finite, shape {shape}"
        if weights.shape != shape:
            raise ValueError(f"{wanted}, not {weights.shape}")
        # One comparison for each bound, false for NaN too.
        fine = (weights > 0.0) & (weights < np.inf)
        if not fine.all():
            env, user = np.argwhere(~fine)[0].tolist()
            raise ValueError(f"{wanted}; user {user} of world {env} has {weights[env, user]}")
        self.state.weight[:] = weights

    def _record(self, num_slots: int, record: SlotRecord | None) -> SlotRecord:
        if not 0 < num_slots <= self.slots_left:
            raise ValueError(f"num_slots = {num_slots}: must be 1 to {self.slots_left}")
        if record is None:
            return self.new_record(num_slots)
        if record.prb_owner.shape[:2] != (self.num_envs, num_slots):
            raise ValueError(
                f"record: {record.prb_owner.shape[:2]} environments and slots, must be "
                f"{(self.num_envs, num_slots)}"
            )
        if record.rows.shape[2] != self._layout.words:
            raise ValueError(
                f"record: rows of {record.rows.shape[2]} words, must be {self._layout.words} (it "
                "is of another scenario)"
            )
        return record

    def _owners(self, prb_owner: NDArray[Any], *num_slots: int) -> NDArray[np.uint32]:
        """Check owners, shape (E, T, K), or (E, K) of one slot."""
        num_users, shape = self.scenario.num_users, (self.num_envs, *num_slots)
        shape = *shape, self.scenario.radio.num_prb
        if prb_owner.shape != shape:
            raise ValueError(f"prb_owner: shape {prb_owner.shape}, must be {shape}")
        if prb_owner.dtype.kind not in "iu":
            raise ValueError(f"prb_owner: of type {prb_owner.dtype}, must be integers")
        wanted = f"prb_owner: every user 0 to {num_users - 1} must own a PRB, and nobody else"
        wrong = (prb_owner < 0) | (prb_owner >= num_users)
        if wrong.any():
            env, *_, prb = np.argwhere(wrong)[0].tolist()
            raise ValueError(f"{wanted}; PRB {prb} of world {env} has {prb_owner[wrong][0]}")
        held = (prb_owner[..., None] == np.arange(num_users)).any(axis=-2)
        if not held.all():
            env, *_, user = np.argwhere(~held)[0].tolist()
            raise ValueError(f"{wanted}; user {user} of world {env} has none")
        return np.ascontiguousarray(prb_owner, dtype=np.uint32)

    def _prepare(self, policy: Rule | Weigher | str | None, weighs: str = "utility") -> Pointer:
        """Compile a policy, or load it; once for this simulator. None: owners are given."""
        key = policy, weighs
        if key not in self._prepared:
            if isinstance(policy, str):
                self._prepared[key] = self._prepare(self.rule(policy), weighs)
            else:
                plugs = {} if policy is None else self._plugs_of(policy, weighs)
                self._prepared[key] = Pointer(self._plugs._replace(**plugs))
        return self._prepared[key]

    def _plugs_of(self, policy: Rule | Weigher, weighs: str) -> dict[str, Plug]:
        if isinstance(policy, Weigher):
            plugs = self._plugs_of(self.rule(policy.rule), policy.weighs)
            return {**plugs, "weigh": self._plug_policy(WEIGH, policy)}
        allocation = policy.allocation
        if weighs != "utility":
            if (weighs, allocation) != ("drift", "lagrangian"):
                raise ValueError(
                    f"weighs = {weighs!r} with the allocation {allocation!r}: must be utility, or "
                    "drift with lagrangian"
                )
            allocation = "weighed_drift"
        if allocation == "own":
            return {"allocate": self._plug_policy(ALLOCATE, policy)}
        if allocation not in ALLOCATIONS:
            raise ValueError(
                f"allocation = {allocation!r}: must be one of {', '.join(ALLOCATIONS)}, or own"
            )
        scenario = self.scenario
        words = ALLOCATIONS[allocation](scenario.num_users, scenario.radio.num_prb)
        return {
            "allocate": self._plug(ALLOCATE, policy, words),
            "rule": self._plug_policy(INDEX, policy, needed=False),
        }

    def _run(
        self,
        policy: Rule | Weigher | str | None,
        record: SlotRecord,
        owners: NDArray[np.uint32] | None = None,
        weighs: str = "utility",
    ) -> None:
        """Run as many slots as the record has, under a compiled policy or by given owners."""
        where = self._prepare(policy, weighs), self._constants, self._state, self._one
        self._call(run_slots, *where, self._no_owners if owners is None else owners, record.rows)

    def set_channel(self, fading_power: NDArray[np.float32]) -> None:
        """Put squared amplitudes, shape (E, U, K), in place of the coming slot's channel."""
        self.state.fading_power[:] = fading_power
        self._call(rate_channels, self._models, self._constants, self._state, self._slot)

    def features(
        self,
        multipliers: NDArray[np.float64],
        *,
        observe_robots: bool = False,
        observe_demand: bool = False,
    ) -> NDArray[np.float32]:
        """Features of every user at the start of the coming slot (`policies.features`), (E, U, F).

        `multipliers` (E, R) of the users' delay constraints are put into the state. With
        `observe_robots`, `ROBOT_FEATURES` follow, with `observe_demand` `DEMAND_FEATURES`; of slice
        means there are none.
        """
        self.state.multiplier[:] = multipliers
        shape = (*self.state.weight.shape, num_features(observe_robots, observe_demand))
        features = np.empty(shape, np.float32)
        where = self._constants, self._state
        observed = bool(observe_robots), bool(observe_demand)
        self._call(observe_worlds, *where, *observed, features)
        return features

    def decide(
        self,
        policy: Rule | Weigher,
        multipliers: NDArray[np.float64] | None = None,
        *,
        weights: NDArray[np.float64] | None = None,
    ) -> NDArray[np.uint32]:
        """Owners (E, K) by a compiled policy in the present state, which does not move on.

        `multipliers` and `weights` as for `run`; they and what the policy computed of them stay in
        the state.
        """
        self._set(policy, weights, multipliers)
        owners = np.zeros((self.num_envs, self.scenario.radio.num_prb), np.uint32)
        where = self._constants, self._state, self._one
        self._call(decide_slots, self._prepare(policy), *where, owners)
        return owners

    def _decision(self, policy: Agent | Policy) -> Weights | Owners:
        """Ask a policy in Python what it does in the coming slot."""
        if not isinstance(policy, Agent):
            return policy.decide(self.view)
        features = self.features(
            self.state.multiplier,
            observe_robots=policy.observe_robots,
            observe_demand=policy.observe_demand,
        )
        return policy.weights(features)

    def _by_slot(self, policy: Agent | Policy, record: SlotRecord) -> None:
        """Ask a policy in Python in every slot."""
        one = self.new_record(1)
        for slot in range(record.prb_owner.shape[1]):
            decision = self._decision(policy)
            if isinstance(decision, Weights):
                self._set_weights(np.asarray(decision.values, np.float64))
                self._run(decision.rule, one, weighs=decision.weighs)
            elif isinstance(decision, Owners):
                self.state.weight[:] = 1.0
                self._run(None, one, self._owners(np.asarray(decision.prb_owner))[:, None])
            else:
                raise ValueError(
                    f"{type(policy).__name__}.decide returned {type(decision).__name__}: must be "
                    "Weights or Owners"
                )
            record.rows[:, slot] = one.rows[:, 0]

    def run_robots(self, network_delay_s: NDArray[np.float64]) -> SlotRecord:
        """Run the robots alone under forced network delays, shape (E, T, R).

        What belongs to the network stays 0 in the record. ValueError on delays of another shape,
        negative or not finite, or slots beyond the horizon.
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
        where = self._models, self._constants, self._state, self._one
        self._call(
            run_robots, *where, np.ascontiguousarray(network_delay_s, np.float64), record.rows
        )
        return record

    def new_record(self, num_slots: int) -> SlotRecord:
        """Zeroed record for `num_slots` slots of all worlds."""
        return self._layout.record(self.num_envs, num_slots)


def _view(state: SlotState, constants: SlotConstants) -> View:
    """Return what a policy in Python is shown, which it cannot write into."""
    arrays: dict[str, NDArray[Any]] = {
        "slot": state.slot,
        "rate_mbps": state.reported_rate_mbps,
        "backlog_packets": state.backlog_packets,
        "hol_delay_s": state.hol_delay_s,
        "average_rate_mbps": state.average_rate_mbps,
        "last_rate_mbps": state.rate_mbps,
        "multiplier": state.multiplier,
        "dexterity_index": state.dexterity_index,
        **{name: getattr(state, name) for name in TASK_STATE},
    }
    shown = {name: _read_only(values) for name, values in arrays.items()}
    return View(**shown, constants=_read_only(constants))


def _read_only(value: Any) -> Any:
    """Return views of arrays, also of those in NamedTuples, through which nothing is written."""
    if isinstance(value, tuple):
        return type(value)(*map(_read_only, value))
    if isinstance(value, np.ndarray):
        value = value.view()
        value.flags.writeable = False
    return value
