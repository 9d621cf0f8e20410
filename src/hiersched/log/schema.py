"""The schema of logs, from the table of fields: topics, descriptors, `.proto` text, documentation.

Integers are fixed32 and fixed64, never varints, and every field is written even when it is zero:
all messages of a topic in one file have one size, so that blocks of them are arrays.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import Any

from google.protobuf.descriptor_pb2 import (
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass

from hiersched.core.fields import FIELDS, LETTERS, TOPIC_MEANINGS, Field

SCHEMA_VERSION = 1
"""For people: readers go by the descriptors in a file."""
LIBRARY = f"hiersched-log/{SCHEMA_VERSION}"  # fixed: a version of NumPy or mcap would change bytes
METADATA_NAME = "hiersched"
MODEL_FIELDS = "model_fields"  # key of the metadata: what the numbers of models are
TOPICS_CRC = "topics_crc32"  # key of the metadata: checksum of the topics, if the log has one
MODELS_TOPIC = "/models"  # the one topic that only some scenarios have
EVENTS_TOPIC = "/events"
EVENTS_SCHEMA = "foxglove.Log"  # a message that viewers know; of its fields we write the first four
LEVELS = ("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")

_LEVEL = "foxglove.Log.Level"
_TIME = "google.protobuf.Timestamp"
_TIME_FILE = "google/protobuf/timestamp.proto"
_PROTO_TYPES = {"<f8": "double", "<f4": "float", "<u4": "fixed32", "<u8": "fixed64"}


@dataclass(frozen=True, kw_only=True)
class LogDims:
    """Dimensions that fix the size of every message.

    Numbers of users of each slice, where every URLLC user drives one robot, and of physical
    resource blocks; of every robot, by default a unicycle, those of states, inputs and standard
    normals a slot; and the number of numbers that models add.
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
        """Sizes by the letters of shapes."""
        return {
            "U": self.num_urllc + self.num_embb,
            "R": self.num_urllc,
            "K": self.num_prb,
            "N": self.num_states,
            "M": self.num_inputs,
            "W": self.num_normals,
            "X": self.num_model_values,
        }


@dataclass(frozen=True, eq=False)
class Topic:
    """A topic of the log: its name, its protobuf message and its fields, without `slot`."""

    name: str
    message: str
    fields: tuple[Field, ...]

    def fields_in(self, profile: str) -> tuple[Field, ...]:
        """Fields that a profile contains."""
        return tuple(field for field in self.fields if profile in field.profiles)


def topics_of(fields: Iterable[Field]) -> Mapping[str, Topic]:
    """Sort a table of fields by topic."""
    topics: dict[str, tuple[Field, ...]] = {}
    for field in fields:
        topics[field.topic] = (*topics.get(field.topic, ()), field)
    return MappingProxyType(
        {
            name: Topic(name, f"hiersched.{name.removeprefix('/').capitalize()}", own)
            for name, own in topics.items()
        }
    )


TOPICS = topics_of(FIELDS)
"""Topics by their names: message, fields, profiles."""


def topics_in(profile: str, num_model_values: int = 0) -> dict[str, Topic]:
    """Topics of a log, by name: `/models` only where models add something."""
    return {
        name: topic
        for name, topic in TOPICS.items()
        if topic.fields_in(profile) and (num_model_values or name != MODELS_TOPIC)
    }


def _declarations(topic: Topic) -> list[str]:
    """Fields of a topic's message, ``repeated double state``, in the order of their numbers."""
    return ["fixed64 slot"] + [
        f"{'repeated ' if field.shape else ''}{_PROTO_TYPES[field.dtype]} {field.name}"
        for field in topic.fields
    ]


def describe(path: str, messages: Mapping[str, Iterable[str]]) -> bytes:
    """Serialise the FileDescriptorSet of messages, dependencies included, as protoc does.

    `path` names the `.proto` file that would have them. `messages` maps full names, of one package,
    to fields, numbered in order: ``repeated double state``; types that are messages by full names.
    """
    (package,) = {name.rpartition(".")[0] for name in messages}
    file = FileDescriptorProto(name=path, package=package, syntax="proto3")
    files = [file]
    for full_name, fields in messages.items():
        message = file.message_type.add(name=full_name.rpartition(".")[2])
        for number, declaration in enumerate(fields, start=1):
            *repeated, kind, name = declaration.split()
            field = message.field.add(name=name, number=number)
            field.json_name = re.sub("_(.)", lambda match: match[1].upper(), name)
            field.label = field.LABEL_REPEATED if repeated else field.LABEL_OPTIONAL
            own = "ENUM" if kind == _LEVEL else "MESSAGE" if "." in kind else kind.upper()
            field.type = FieldDescriptorProto.Type.Value(f"TYPE_{own}")
            if "." in kind:
                field.type_name = f".{kind}"
            if kind == _LEVEL:
                levels = message.enum_type.add(name="Level").value
                for value, level in enumerate(LEVELS):
                    levels.add(name=level, number=value)
            if kind == _TIME and not file.dependency:
                file.dependency.append(_TIME_FILE)
                time = describe(_TIME_FILE, {_TIME: ("int64 seconds", "int32 nanos")})
                files = [*FileDescriptorSet.FromString(time).file, file]
    return FileDescriptorSet(file=files).SerializeToString(deterministic=True)


def descriptors() -> bytes:
    """Return the serialised FileDescriptorSet of the messages of all `TOPICS`."""
    return _describe_topics(tuple(TOPICS.values()))


@cache
def _describe_topics(topics: tuple[Topic, ...]) -> bytes:
    return describe("hiersched.proto", {t.message: _declarations(t) for t in topics})


@cache
def event_descriptors() -> bytes:
    """Return the serialised FileDescriptorSet of `foxglove.Log`, numbered as in public."""
    fields = f"{_TIME} timestamp", f"{_LEVEL} level", "string message", "string name"
    return describe("foxglove/Log.proto", {EVENTS_SCHEMA: (*fields, "string file", "fixed32 line")})


@cache
def message_class(descriptor_set: bytes, name: str) -> Any:
    """Protobuf class of a message of a serialised FileDescriptorSet."""
    pool = DescriptorPool()  # of its own: a viewer may know other versions of the same messages
    for file in FileDescriptorSet.FromString(descriptor_set).file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(name))


def proto_source() -> str:
    """Text of ``hiersched.proto``, which every log carries as an attachment."""
    return _proto_source(tuple(TOPICS.values()))


@cache
def _proto_source(topics: tuple[Topic, ...]) -> str:
    lines = [
        "// What hiersched logs about one slot: one message per topic and slot.",
        "//",
        f"// Schema version {SCHEMA_VERSION}. Shapes, in brackets: "
        + ", ".join(f"{letter} {meaning}" for letter, meaning in LETTERS.items())
        + ".",
        "// Arrays are row-major; the metadata record has the sizes. Every field is written, even",
        "// if it is zero. Behind the meaning stand the profiles of logs that contain a field.",
        "",
        'syntax = "proto3";',
        "",
        "package hiersched;",
    ]
    for topic in topics:
        lines += ["", f"// {topic.name}: {TOPIC_MEANINGS.get(topic.name, '')}"]
        lines.append(f"message {topic.message.rpartition('.')[2]} {{")
        notes = ["number of the slot", *map(_note, topic.fields)]
        for number, (text, note) in enumerate(zip(_declarations(topic), notes, strict=True), 1):
            lines.append(f"  {text} = {number};  // {note}")
        lines.append("}")
    return "\n".join([*lines, ""])


def _note(field: Field) -> str:
    shape = " ".join(map(str, field.shape))
    return f"({shape}) [{field.unit}] {field.meaning}; {', '.join(field.profiles)}"


def field_table() -> str:
    """Markdown table of all fields, for the documentation."""
    rows = [("topic", "field", "type", "shape", "unit", "profiles", "meaning"), ("---",) * 7]
    for field in (field for topic in TOPICS.values() for field in topic.fields):
        shape = " ".join(map(str, field.shape))
        names = f"`{field.topic}`", f"`{field.name}`", _PROTO_TYPES[field.dtype]
        meaning = field.meaning.replace("|", r"\|")
        rows.append((*names, shape, field.unit, ", ".join(field.profiles), meaning))
    return "\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n"
