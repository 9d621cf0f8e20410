"""How messages lie in a file: NumPy structured types of whole MCAP Message records.

Messages of a topic have one size, so a Message record (framing, protobuf tags and values) is one
element of a structured array, and blocks of slots are written and read without a loop over
messages.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorSet
from mcap.opcode import Opcode
from numpy.typing import NDArray

from hiersched.log import schema
from hiersched.log.schema import LogDims, Topic

HEADER = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
RECORD_PREFIX_BYTES = 9  # opcode and length, which the length does not count
_HEADER_PARTS = [
    ("header:opcode", "u1"),
    ("header:length", "<u8"),
    ("header:channel_id", "<u2"),
    ("header:sequence", "<u4"),
    ("header:log_time", "<u8"),
    ("header:publish_time", "<u8"),
]
_DTYPES: dict[int, np.dtype[Any]] = {
    FieldDescriptorProto.TYPE_DOUBLE: np.dtype("<f8"),
    FieldDescriptorProto.TYPE_FLOAT: np.dtype("<f4"),
    FieldDescriptorProto.TYPE_FIXED32: np.dtype("<u4"),
    FieldDescriptorProto.TYPE_FIXED64: np.dtype("<u8"),
    FieldDescriptorProto.TYPE_SFIXED32: np.dtype("<i4"),
    FieldDescriptorProto.TYPE_SFIXED64: np.dtype("<i8"),
}
_PACKED = 2  # wire type of protobuf; those of single numbers by their bytes:
_WIRE_TYPES = {4: 5, 8: 1}


@dataclass(frozen=True)
class RecordLayout:
    """How the messages of one topic lie in a file.

    A record is the header, then ``slot`` and the fields, each behind a part ``<name>:tag`` with
    protobuf's tag and length. Fields that today's table does not have, in this type and size, have
    the shape (n,), as the schema in a file says nothing else.
    """

    dtype: np.dtype[Any]  # of one whole Message record
    template: NDArray[Any]  # shape (1,)
    constants: tuple[str, ...]  # parts that are the same in every record, as in the template
    values: Mapping[str, tuple[np.dtype[Any], tuple[int, ...]]]  # type and shape, but for slot
    unknown: frozenset[str]  # fields that today's table does not have


@dataclass(frozen=True)
class TopicSchema:
    """What a file says of one topic; no layout where that depends on its messages."""

    channel_id: int
    message: str
    descriptors: bytes
    layout: RecordLayout | None = None


def topics_crc32(schemas: Mapping[str, TopicSchema]) -> str:
    """Return a checksum of what a file says about its topics: names, channels and messages."""
    crc = 0
    for name, topic in sorted(schemas.items()):
        head = f"{name} {topic.channel_id} {topic.message} ".encode()
        crc = zlib.crc32(topic.descriptors, zlib.crc32(head, crc))
    return f"{crc:08x}"


@lru_cache(maxsize=64)
def find_message(descriptors: bytes, name: str) -> DescriptorProto:
    """Find a message by its full name in a serialised FileDescriptorSet; ValueError without it."""
    for file in FileDescriptorSet.FromString(descriptors).file:
        for message in file.message_type:
            if f"{file.package}.{message.name}" == name:
                return message
    raise ValueError(f"the schema does not describe {name}")


def empty_record(topic: Topic, dims: LogDims, profile: str, channel_id: int) -> bytes:
    """Make a Message record with zeros in the fields of a profile."""
    body = _tag(1, 1) + bytes(8)  # the slot
    for number, field in enumerate(topic.fields, start=2):
        if profile in field.profiles:
            itemsize = np.dtype(field.dtype).itemsize
            nbytes = itemsize * math.prod(field.sized(dims.sizes))
            if field.shape:
                body += _tag(number, _PACKED) + _varint(nbytes) + bytes(nbytes)
            else:
                body += _tag(number, _WIRE_TYPES[itemsize]) + bytes(nbytes)
    length = HEADER.size + len(body) - RECORD_PREFIX_BYTES
    return HEADER.pack(Opcode.MESSAGE, length, channel_id, 0, 0, 0) + body


def record_layout(
    topic: str, message: DescriptorProto, dims: LogDims, record: bytes
) -> RecordLayout:
    """Lay out the Message records of a topic as one of them lies there.

    The file's own description of the message says which fields those are; `dims` give the shapes of
    those that today's table has. ValueError if the record does not follow the description, or that
    has fields without a fixed size.
    """
    described = {field.number: field for field in message.field}
    shapes = _known_shapes(schema.TOPICS[topic], dims) if topic in schema.TOPICS else {}
    parts: list[Any] = list(_HEADER_PARTS)
    values: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}
    unknown = set()
    place = HEADER.size
    while place < len(record):
        tag, value = _read_varint(record, place)
        if (field := described.pop(tag >> 3, None)) is None:
            raise ValueError(f"field {tag >> 3} is not in the schema, or there twice")
        dtype, is_array = _type_of(field, tag & 7)
        name, nbytes = field.name, dtype.itemsize
        shape: tuple[int, ...] = ()
        if is_array:
            nbytes, value = _read_varint(record, value)
            shape = (nbytes // dtype.itemsize,)
        wanted = shapes.get((name, dtype, is_array))
        if wanted is not None and math.prod(wanted) == math.prod(shape):
            shape = wanted
        else:
            unknown.add(name)
        parts += [(f"{name}:tag", "u1", (value - place,)), (name, dtype, shape)]
        values[name] = dtype, shape
        place = value + nbytes
    whole = np.dtype(parts)
    if whole.itemsize != len(record) or values.pop("slot", None) != (np.dtype("<u8"), ()):
        raise ValueError("a message does not end with its last field, or has no slot")
    tags = (name for name, *_ in parts if name.endswith(":tag"))
    constants = ("header:opcode", "header:length", "header:channel_id", *tags)
    template = np.frombuffer(record, whole)
    return RecordLayout(whole, template, constants, values, frozenset(unknown - {"slot"}))


@cache
def _known_shapes(
    topic: Topic, dims: LogDims
) -> dict[tuple[str, np.dtype[Any], bool], tuple[int, ...]]:
    """Shapes of the fields that today's table has, by name, type and whether they are arrays."""
    return {
        (field.name, np.dtype(field.dtype), bool(field.shape)): field.sized(dims.sizes)
        for field in topic.fields
    }


def _type_of(field: FieldDescriptorProto, wire_type: int) -> tuple[np.dtype[Any], bool]:
    """Type of a field's numbers, and whether they are an array."""
    is_array = field.label == field.LABEL_REPEATED
    if field.type not in _DTYPES:
        kind = FieldDescriptorProto.Type.Name(field.type)
        raise ValueError(f"{field.name} is of {kind}, which has no fixed size")
    dtype = _DTYPES[field.type]
    if wire_type != (_PACKED if is_array else _WIRE_TYPES[dtype.itemsize]):
        raise ValueError(f"{field.name} has wire type {wire_type}")
    return dtype, is_array


def _tag(number: int, wire_type: int) -> bytes:
    return _varint(number << 3 | wire_type)


def _varint(value: int) -> bytes:
    """Protobuf's base-128 encoding of a non-negative integer."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _read_varint(data: bytes, place: int) -> tuple[int, int]:
    """Decode a number of base 128; returns it and the place behind it."""
    value = shift = 0
    while data[place] & 0x80:
        value |= (data[place] & 0x7F) << shift
        place, shift = place + 1, shift + 7
    return value | data[place] << shift, place + 1


def as_raw(values: NDArray[Any]) -> NDArray[Any]:
    """View an array (T, ...) as T pieces of raw bytes, shape (T,) of a void type.

    Copying those is one memcpy a slot, and no value can change on the way. It is a copy if a slot
    does not lie in one piece; shape (T, 0) where there are no bytes.
    """
    nbytes = values.itemsize * math.prod(values.shape[1:])
    if nbytes == 0:
        return values.reshape(len(values), 0)
    if values.flags.c_contiguous:
        # Straight from the buffer: reshaping and viewing takes longer than copying a few slots.
        return np.ndarray(len(values), _void(nbytes), values)
    flat = values.reshape(len(values), -1)
    if flat.shape[1] > 1 and flat.strides[1] != flat.itemsize:
        flat = np.ascontiguousarray(flat)
    return flat.view(_void(nbytes))[:, 0]


@cache
def _void(nbytes: int) -> np.dtype[Any]:
    return np.dtype(f"V{nbytes}")


def raw_columns(rows: NDArray[Any], layout: RecordLayout) -> dict[str, NDArray[Any]]:
    """View each field that has bytes, in message records (T,), as raw bytes (T,)."""
    places = layout.dtype.fields
    assert places is not None  # it is a structured type
    names = [name for name, (_, shape) in layout.values.items() if 0 not in shape]
    dtype = np.dtype(
        {
            "names": names,
            "formats": [f"V{places[name][0].itemsize}" for name in names],
            "offsets": [places[name][1] for name in names],
            "itemsize": layout.dtype.itemsize,
        }
    )
    raw = rows.view(dtype)
    return {name: raw[name] for name in names}
