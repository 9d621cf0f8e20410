"""What a model is: parameters from a scenario, words for its kernel, faults that it can name."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from operator import attrgetter
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Literal,
    NamedTuple,
    TypeVar,
    get_args,
    get_type_hints,
)

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ConfigDict

from hiersched.core.fields import ModelField
from hiersched.core.parameters import STRICT, Note
from hiersched.core.registry import PluginError, Registry
from hiersched.models.plant.command_link import LINK_FIELDS, link_memory
from hiersched.models.plant.estimator import estimate_fields, filter_memory
from hiersched.models.plant.feedback import LoopMemory

if TYPE_CHECKING:
    from hiersched.control import DelayedPlant
    from hiersched.control.lqg import FilterModel
    from hiersched.scenario.schema import Scenario


@dataclass(frozen=True, kw_only=True)
class Setup:
    """For what a model makes its words: the run of a batch of worlds."""

    scenario: Scenario
    num_envs: int  # worlds side by side, E
    num_slots: int  # of an episode, T
    kinds: tuple[Scenario, ...] = ()  # of robots, G; all are alike unless given

    def of_kinds(self, value: Callable[[Scenario], ArrayLike]) -> NDArray[np.float64]:
        """Return a value of each kind of robot, shape (G, …)."""
        return np.array([value(kind) for kind in self.kinds or (self.scenario,)], np.float64)

    def of_robots(self, value: Callable[[Scenario], ArrayLike]) -> NDArray[np.float64]:
        """Return a value of each robot, shape (R, …)."""
        return self.of_kinds(value)[list(self.scenario.kind_of_robot)]

    def loop_memory(self, n: int, m: int) -> LoopMemory:
        """Return what the loops of the robots remember, for n states and m inputs: nothing yet."""
        scenario, of_robot = self.scenario, (self.num_envs, self.scenario.users.num_urllc)
        length_s = self.num_slots * scenario.radio.slot_s
        samples = math.ceil(length_s / scenario.control.sampling_s - 1e-9)
        size = scenario.filter_size
        places = samples if size else scenario.max_delay_steps
        return LoopMemory(
            history=np.zeros((*of_robot, samples + 1, n)),
            commands=np.zeros((*of_robot, places + 1, m)),
            control=np.zeros((*of_robot, m)),
            held=np.zeros((*of_robot, 2), np.int64),
            filter=filter_memory(
                of_robot,
                samples,
                size,
                m,
                max(scenario.playout_steps, scenario.packet_horizon),
                kinds=len(scenario.robot_kinds) + 1,
                is_known=scenario.control.known_motion,
            ),
            link=link_memory(
                of_robot,
                samples,
                m,
                scenario.playout_steps,
                scenario.packet_horizon,
                scenario.latency_steps,
            ),
        )

    def first_value(self, model: Model, name: str) -> int:
        """Return where a field of a model's `log_fields` begins in `state.model_values[env]`.

        ValueError if the scenario does not have this very model, or the model not this field.
        """
        for field in model_fields(self.scenario):
            key, _, own = field.name.partition("/")
            if own == name and attrgetter(key)(self.scenario) is model:
                return field.start
        raise ValueError(f"{name}: no field of {model!r} in this scenario")


class Belief(NamedTuple):
    """What a base station expects of the arrivals, per user (U,), URLLC first.

    Mean packets of a slot at the rate r: max(0, offered_mbps - rate_sensitivity r) times
    packets_per_mbps. `mean_due_packets`: packets a slot at the offered load.
    """

    offered_mbps: NDArray[np.float64]
    rate_sensitivity: NDArray[np.float64]
    packets_per_mbps: NDArray[np.float64]
    mean_due_packets: NDArray[np.float64]


class Model:
    """Base of all models: a frozen dataclass with `model: Literal["name"]` and its parameters.

    A key with a default may be left out of a scenario. A `Note` in the annotation of a key says
    what it means in the table of parameters.

    `log_fields` are what it adds to the log beside the fields that all runs have, name -> unit; one
    number a user, or a robot for a plant, every slot. Its kernels write them into
    `state.model_values[env]`, each from `Setup.first_value` on: those that draw or rate the channel
    for the coming slot, all others for the present one. What is not written is 0.
    """

    if TYPE_CHECKING:

        @property
        def model(self) -> str:
            """Name of the model: a field of every subclass."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT
    log_fields: ClassVar[Mapping[str, str]] = {}

    @classmethod
    def notes(cls) -> dict[str, Note]:
        """Return what is said of each key; a key of which nothing is said is assumed."""
        hints = get_type_hints(cls, include_extras=True)
        said = {
            field.name: [note for note in get_args(hints[field.name])[1:] if isinstance(note, Note)]
            for field in fields(cls)  # type: ignore[arg-type]  # models are dataclasses
        }
        return {key: notes[0] if notes else Note("", "assumed", "") for key, notes in said.items()}

    def faults(self, scenario: Scenario) -> list[str]:
        """Say what does not fit the rest of the scenario, as ``key = value: what is allowed``."""
        return []

    def words(self, setup: Setup) -> Any:
        """Return what the kernels get as `me`, a NamedTuple of numbers and arrays; None: none."""
        return None

    def reset(self, words: Any, keys: NDArray[np.uint64]) -> None:
        """Bring the words back to the start of an episode in the worlds `keys` (E,), in place."""


class PathLoss(Model):
    """What distance and obstacles take of the power."""

    def gain(self, key: int, num_users: int) -> NDArray[np.float64]:
        """Return the large-scale gains in the world `key`, linear, shape (num_users,)."""
        raise NotImplementedError

    def least_gain_db(self) -> float:
        """Return a gain below which no user's is, for the check of the link budget [dB]."""
        return 0.0


class Arrivals(Model):
    """What is offered to the cell."""

    def belief(self, scenario: Scenario) -> Belief:
        """Return what the base station expects."""
        raise NotImplementedError

    @staticmethod
    def offered_mbps(scenario: Scenario) -> NDArray[np.float64]:
        """Return the offered load of every user, shape (U,) [Mbit/s].

        `load` multiplies all of them; `load_ratio` changes the ratio of the mean loads of eMBB and
        URLLC users, not the sum of both means, nor the spread within a slice.
        """
        traffic, users = scenario.traffic, scenario.users
        urllc, embb = (
            np.broadcast_to(np.asarray(value, np.float64), (count,))
            for value, count in (
                (traffic.urllc_offered_mbps, users.num_urllc),
                (traffic.embb_offered_mbps, users.num_embb),
            )
        )
        if (ratio := traffic.load_ratio) is not None:
            of_urllc, of_embb = np.mean(urllc), np.mean(embb)
            total = (of_urllc + of_embb) / (1.0 + ratio)
            urllc, embb = urllc * float(total / of_urllc), embb * float(ratio * total / of_embb)
        return traffic.load * np.concatenate([urllc, embb])

    def packets_at_once(self) -> float:
        """Return how many packets come together: shares of late ones differ by this many."""
        return 1.0


class Plant(Model):
    """What the robots are.

    `has_pose`: whether robots have a position, for what looks at it, and a reference that may be
    late. `chooses_loop`: whether
    `control.loop` decides what crosses the network. `design_keys`: keys on which `design` depends;
    None: on all. `num_disturbances`: states of `filter_model` behind those of the plant.
    `kind_keys`: dotted keys in which `robot_kinds` may make robots differ; `words` takes those of
    each from `Setup.of_robots`.
    """

    has_pose: ClassVar[bool] = False
    chooses_loop: ClassVar[bool] = False
    design_keys: ClassVar[tuple[str, ...] | None] = None
    num_disturbances: ClassVar[int] = 0
    kind_keys: ClassVar[tuple[str, ...]] = ()

    def loop(self, scenario: Scenario) -> Literal["network", "split", "local"]:
        """Return what crosses the network: all feedback, a part, or none."""
        return scenario.control.loop if self.chooses_loop else "network"

    def sizes(self, scenario: Scenario) -> tuple[int, int, int]:
        """Return n states, m inputs, and standard normals that a robot takes a slot."""
        raise NotImplementedError

    def design(self, scenario: Scenario) -> DelayedPlant:
        """Return the linear plant for which the gains are designed."""
        raise NotImplementedError

    def filter_model(self, scenario: Scenario) -> FilterModel:
        """Return what the filter of the method lqg believes: the plant, and what disturbs it.

        Its first states are those of the plant. ValueError, which says why, if there is none.
        """
        raise ValueError(f"plant.model = {self.model!r} says nothing of its noise (`filter_model`)")

    def position_states(self) -> tuple[int, ...]:
        """Return the states whose norm is the position error."""
        return (0, 1)

    def motion_models(
        self, scenario: Scenario
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return A, A_speed, B, B_speed of `FilterConstants` where the reference's motion is known.

        ValueError, which says why, if there is no such motion.
        """
        raise ValueError(f"plant.model = {self.model!r} follows no reference")


M = TypeVar("M", bound=type[Model])


class Section(Registry[type[Model]]):
    """A place in a scenario that says which model it means: its dotted key, as `radio.path_loss`.

    Models here are of the class `base`; `example` is one that needs no keys, for messages.
    """

    def __init__(self, key: str, base: type[Model], example: str) -> None:
        super().__init__(f"{key}.model")
        self.key, self.base, self.example = key, base, example

    def model(self, cls: M) -> M:
        """Register the decorated dataclass under the name in its `model: Literal["name"]`.

        PluginError if it has no such field, or is no frozen dataclass, or no model of this kind; or
        what it logs has no proper name.
        """
        names = get_args(get_type_hints(cls).get("model"))
        is_frozen = "__dataclass_fields__" in vars(cls) and cls.__dataclass_params__.frozen  # type: ignore[attr-defined]
        if len(names) != 1 or not issubclass(cls, self.base) or not is_frozen:
            raise PluginError(
                f"{cls.__qualname__}: a model of {self.key} is a frozen dataclass, a "
                f'{self.base.__name__}, with a field `model: Literal["its_name"]`'
            )
        if cls.log_fields and self.key not in SECTIONS:
            raise PluginError(f"{cls.__qualname__}.log_fields: a model of {self.key} logs nothing")
        if wrong := [name for name in cls.log_fields if not name.isidentifier()]:
            raise PluginError(f"{cls.__qualname__}.log_fields: {wrong[0]!r}: must be a name")
        self.add(names[0], cls)
        return cls


PATH_LOSS = Section("radio.path_loss", PathLoss, "none")
FADING = Section("radio.fading", Model, "rayleigh")
REPORT = Section("radio.report", Model, "truth")
LINK = Section("radio.link", Model, "shannon")
ARRIVALS = Section("traffic.arrivals", Arrivals, "poisson")
QUEUE = Section("traffic.queue", Model, "fifo")
PLANT = Section("plant", Plant, "unicycle")

SECTIONS = {
    section.key: section for section in (PATH_LOSS, FADING, REPORT, LINK, ARRIVALS, QUEUE, PLANT)
}
"""All places of a scenario that name a model, by dotted key."""


def models_of(scenario: Scenario) -> dict[str, Model]:
    """Return the models of a scenario by the last part of their key, in the order of `SECTIONS`."""
    return {key.rpartition(".")[2]: attrgetter(key)(scenario) for key in SECTIONS}


def model_fields(scenario: Scenario) -> tuple[ModelField, ...]:
    """Return what the models of a scenario add to the log, in the order of `SECTIONS`.

    The filters of its robots add to what their plant does.
    """
    found: list[ModelField] = []
    start = 0
    for key in SECTIONS:
        model: Model = attrgetter(key)(scenario)
        count = scenario.users.num_urllc if isinstance(model, Plant) else scenario.num_users
        own = dict(model.log_fields)
        if isinstance(model, Plant) and scenario.filter_size:
            own |= estimate_fields(scenario.robot_sizes[0])
            own |= LINK_FIELDS if scenario.control.link != "measurements" else {}
        for name, unit in own.items():
            if count:
                found.append(ModelField(f"{key}/{name}", unit, start, count))
                start += count
    return tuple(found)


def num_model_values(scenario: Scenario) -> int:
    """Return how many numbers the models of a scenario add to the record of a slot."""
    return sum(field.count for field in model_fields(scenario))
