"""What the log contains: topics and fields.

The table `TOPICS` mirrors ``hiersched.proto``. All fields have a fixed size once the numbers of
users, robots and PRBs are known.

The compiled schemas lie beside the ``.proto`` files. After a change, in this directory::

    python -m grpc_tools.protoc -I . --include_imports --descriptor_set_out=hiersched.binpb \
        hiersched.proto
    python -m grpc_tools.protoc -I . --include_imports --descriptor_set_out=foxglove/Log.binpb \
        foxglove/Log.proto
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Any, Literal, get_args

import numpy as np
from google.protobuf.descriptor_pb2 import DescriptorProto, FileDescriptorSet
from google.protobuf.message import DecodeError

SCHEMA_VERSION = 1
LIBRARY = f"hiersched-log/{SCHEMA_VERSION}"  # fixed: a version of NumPy or mcap would change bytes
METADATA_NAME = "hiersched"
EVENTS_TOPIC = "/events"
MODEL_FIELDS = "model_fields"  # key of the metadata: what the numbers of models are
MODELS_TOPIC = "/models"  # the one topic that only some scenarios have
EVENTS_SCHEMA = "foxglove.Log"

Profile = Literal["full", "compact", "decisions", "robots"]
PROFILES: tuple[str, ...] = get_args(Profile)

# Which profiles contain a field. Whatever a smaller one leaves out, replay computes again.
_DECISIONS = ("full", "compact", "decisions")
_FULL = ("full",)
_COMPACT = ("full", "compact")  # what the study reads of a run, besides the decisions
_ROBOTS = ("full", "compact", "robots")  # what the study reads of robots that run alone
_SUMS = ("decisions",)  # of slices, in place of the users' numbers


@dataclass(frozen=True, kw_only=True)
class LogDims:
    """Dimensions that fix the size of every message.

    Parameters
    ----------
    num_urllc, num_embb
        Numbers of users of each slice; every URLLC user drives one robot.
    num_prb
        Number of physical resource blocks.
    num_states, num_inputs, num_normals
        Of every robot, by default a unicycle: states, inputs, standard normals a slot.
    num_model_values
        Numbers that the models add.
    """

    num_urllc: int
    num_embb: int
    num_prb: int
    num_states: int = 5
    num_inputs: int = 2
    num_normals: int = 5
    num_model_values: int = 0

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            least = 0 if name in ("num_urllc", "num_embb", "num_model_values") else 1
            if getattr(self, name) < least:
                raise ValueError(f"{name} is {getattr(self, name)}; allowed: at least {least}")
        if self.num_urllc + self.num_embb < 1:
            raise ValueError("num_urllc + num_embb is 0; allowed: at least 1 user")

    @property
    def num_posed(self) -> int:
        """Robots that have a pose in the plane: unicycles."""
        is_unicycle = (self.num_states, self.num_inputs, self.num_normals) == (5, 2, 5)
        return self.num_urllc if is_unicycle else 0

    @property
    def sizes(self) -> dict[str, int]:
        """Sizes by the letters of the table of fields.

        U users, R robots, K PRBs; of a robot N states, M inputs, W normals; X numbers of models.
        """
        return {
            "U": self.num_urllc + self.num_embb,
            "R": self.num_urllc,
            "K": self.num_prb,
            "N": self.num_states,
            "M": self.num_inputs,
            "W": self.num_normals,
            "X": self.num_model_values,
        }


@dataclass(frozen=True)
class Field:
    """One protobuf field of fixed size.

    Parameters
    ----------
    name, number
        As in ``hiersched.proto``.
    dtype
        Little-endian NumPy type: ``<f8`` double, ``<f4`` float, ``<u4`` fixed32, ``<u8`` fixed64.
    shape
        Of one slot's value, in the letters of `LogDims.sizes` and numbers; ``()`` is a scalar, all
        else is packed.
    profiles
        Those that contain it.
    """

    name: str
    number: int
    dtype: str
    shape: tuple[str | int, ...]
    profiles: tuple[str, ...] = _DECISIONS

    def concrete_shape(self, dims: LogDims) -> tuple[int, ...]:
        """Shape of one slot's value for given dimensions."""
        return tuple(dims.sizes[n] if isinstance(n, str) else n for n in self.shape)

    def prefix(self, dims: LogDims) -> bytes:
        """Protobuf tag, and for packed fields the length in bytes, that precede the value."""
        itemsize = np.dtype(self.dtype).itemsize
        if self.shape == ():
            return _varint(self.number << 3 | (1 if itemsize == 8 else 5))
        nbytes = itemsize * int(np.prod(self.concrete_shape(dims)))
        return _varint(self.number << 3 | 2) + _varint(nbytes)


@dataclass(frozen=True)
class Topic:
    """A topic of the log.

    Parameters
    ----------
    name, message
        MCAP topic and protobuf message.
    fields
        Its fields, `slot` first.
    stored
        Never compressed: random numbers, of which zstd saves 10 % for a quarter of the writer's
        time and a third of the reader's.
    """

    name: str
    message: str
    fields: tuple[Field, ...]
    stored: bool = False

    def fields_in(self, profile: str) -> tuple[Field, ...]:
        """Fields that a profile contains, `slot` first; empty when it leaves the topic out."""
        if profile not in PROFILES:
            raise ValueError(f"profile is {profile!r}; allowed: {', '.join(PROFILES)}")
        slot, *others = (field for field in self.fields if profile in field.profiles)
        return (slot, *others) if others else ()


def _topic(name: str, *fields: tuple[Any, ...], stored: bool = False) -> tuple[str, Topic]:
    """Entry of the table: fields are numbered in order, after `slot` = 1."""
    numbered = [Field("slot", 1, "<u8", (), PROFILES)]
    numbered += [Field(f[0], i, *f[1:]) for i, f in enumerate(fields, start=2)]
    message = "hiersched." + name.removeprefix("/").capitalize()
    return name, Topic(name, message, tuple(numbered), stored)


TOPICS: Mapping[str, Topic] = MappingProxyType(
    dict(
        [
            _topic(
                "/channel",
                ("fading_power", "<f4", ("U", "K"), _FULL),
                ("mean_fading_power", "<f4", ("U",), _COMPACT),
                stored=True,
            ),
            _topic(
                "/world",
                ("arrival_uniform", "<f8", ("U",), _FULL),
                ("robot_normal", "<f4", ("R", "W"), _FULL),
                stored=True,
            ),
            _topic(
                "/allocation",
                ("prb_owner", "<u4", ("K",)),
                ("num_prb", "<u4", ("U",), _COMPACT),
                ("rate_mbps", "<f8", ("U",), _COMPACT),
                ("weight", "<f4", ("U",), _COMPACT),
            ),
            _topic(
                "/queue",
                ("backlog_packets", "<f8", ("U",), _COMPACT),
                ("arrivals_packets", "<u4", ("U",), _COMPACT),
                ("service_packets", "<f8", ("U",), _COMPACT),
                ("average_rate_mbps", "<f8", ("U",), _FULL),
            ),
            _topic(
                "/delay",
                ("hol_delay_s", "<f8", ("U",), _FULL),
                ("delay_s", "<f8", ("U",), _FULL),
                ("due_packets", "<u4", ("U",), _COMPACT),
                ("late_packets", "<u4", ("U",), _COMPACT),
                ("arrival_clamped", "<u4", ("U",), _COMPACT),
                ("multiplier", "<f8", ("R",)),
                ("constraint", "<f8", ("R",), _FULL),
                ("drift_urllc", "<f8", (), _COMPACT),
                ("drift_embb", "<f8", (), _COMPACT),
                ("penalty_urllc", "<f8", (), _COMPACT),
                ("penalty_embb", "<f8", (), _COMPACT),
                ("reward_urllc", "<f8", ()),
                ("reward_embb", "<f8", ()),
            ),
            _topic(
                "/robots",
                ("network_delay_s", "<f8", ("R",), _FULL),
                ("delay_steps", "<u4", ("R",), _ROBOTS),
                ("delay_capped", "<u4", ("R",), _ROBOTS),
                ("gain_delay_steps", "<u4", ("R",), _FULL),
                ("state", "<f8", ("R", "N"), _FULL),
                ("reference", "<f8", ("R", 5), _FULL),
                ("control", "<f8", ("R", "M"), _FULL),
                ("control_saturated", "<u4", ("R",), _ROBOTS),
                ("tracking_error_m", "<f8", ("R",), _ROBOTS),
                ("dexterity_index", "<f8", ("R",), _ROBOTS),
            ),
            _topic(
                "/slices",
                ("backlog_urllc_packets", "<f8", (), _SUMS),
                ("backlog_embb_packets", "<f8", (), _SUMS),
                ("due_urllc_packets", "<u4", (), _SUMS),
                ("due_embb_packets", "<u4", (), _SUMS),
                ("late_urllc_packets", "<u4", (), _SUMS),
                ("late_embb_packets", "<u4", (), _SUMS),
            ),
            _topic(MODELS_TOPIC, ("model_values", "<f8", ("X",), _COMPACT)),
        ]
    )
)


def topics_in(profile: str, num_model_values: int = 0) -> dict[str, Topic]:
    """Topics of a log, by name: `/models` only where models add something."""
    return {
        name: topic
        for name, topic in TOPICS.items()
        if topic.fields_in(profile) and (num_model_values or name != MODELS_TOPIC)
    }


def channel_ids(profile: str, num_model_values: int = 0) -> dict[str, int]:
    """MCAP channel (and schema) id of each topic of a log, `/events` last."""
    names = [*topics_in(profile, num_model_values), EVENTS_TOPIC]
    return {name: i for i, name in enumerate(names, start=1)}


@cache
def descriptor_set(message: str) -> bytes:
    """Return the serialised FileDescriptorSet that describes a message, dependencies included."""
    name = "foxglove/Log.binpb" if message == EVENTS_SCHEMA else "hiersched.binpb"
    return files(__package__).joinpath(name).read_bytes()


@cache
def describes(descriptors: bytes, message: str) -> bool:
    """Say whether a serialised FileDescriptorSet describes a message as ours does.

    Other messages in it do not matter: sets of older versions lack topics that came later.
    """
    if descriptors == descriptor_set(message):
        return True
    try:
        given = FileDescriptorSet.FromString(descriptors)
    except DecodeError:
        return False
    ours = FileDescriptorSet.FromString(descriptor_set(message))
    return (own := _named(ours, message)) is not None and own == _named(given, message)


def _named(descriptors: FileDescriptorSet, message: str) -> DescriptorProto | None:
    """Find a message by its full name."""
    for file in descriptors.file:
        for entry in file.message_type:
            if f"{file.package}.{entry.name}" == message:
                return entry
    return None


@cache
def proto_source() -> bytes:
    """Return the text of ``hiersched.proto``, which every log carries as an attachment."""
    return files(__package__).joinpath("hiersched.proto").read_bytes()


def _varint(value: int) -> bytes:
    """Protobuf's base-128 encoding of a non-negative integer."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)
