"""How messages lie in a file: NumPy structured types of whole MCAP Message records.

Messages of a topic have one size, so a Message record (framing, protobuf tags and values) is one
element of a structured array, and blocks of slots are written and read without a loop over
messages.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from hiersched.log.schema import LogDims, Topic

RECORD_PREFIX_BYTES = 9  # opcode and length, which the length does not count
MESSAGE_HEADER: list[tuple[str, str]] = [
    ("opcode", "u1"),
    ("length", "<u8"),
    ("channel_id", "<u2"),
    ("sequence", "<u4"),
    ("log_time", "<u8"),
    ("publish_time", "<u8"),
]


@dataclass(frozen=True)
class RecordLayout:
    """How the messages of one topic lie in a file.

    Parameters
    ----------
    dtype
        Structured type of one whole Message record: the header, ``slot``, the fields, and before
        each of these a part ``<name>:tag`` with protobuf's tag and length.
    template
        One record, shape (1,), with every constant part filled in.
    constants
        Names of the parts that are the same in every record.
    values
        Name -> (type, shape) of each field of one slot, but for ``slot``.
    """

    dtype: np.dtype[Any]
    template: NDArray[Any]
    constants: tuple[str, ...]
    values: Mapping[str, tuple[np.dtype[Any], tuple[int, ...]]]


def record_layout(topic: Topic, dims: LogDims, profile: str, channel_id: int) -> RecordLayout:
    """Lay out the Message records of a topic.

    Parameters
    ----------
    topic
        A topic that the profile contains.
    dims
        Numbers of users and PRBs.
    profile
        One of `PROFILES`.
    channel_id
        MCAP channel id of the topic in the file.
    """
    fields = topic.fields_in(profile)
    prefixes = {f"{field.name}:tag": field.prefix(dims) for field in fields}
    parts: list[Any] = list(MESSAGE_HEADER)
    for field in fields:
        parts.append((f"{field.name}:tag", "u1", (len(prefixes[f"{field.name}:tag"]),)))
        parts.append((field.name, field.dtype, field.concrete_shape(dims)))
    dtype = np.dtype(parts)
    template = np.zeros(1, dtype)
    template["opcode"] = int(Opcode.MESSAGE)
    template["length"] = dtype.itemsize - RECORD_PREFIX_BYTES
    template["channel_id"] = channel_id
    for name, prefix in prefixes.items():
        template[name] = np.frombuffer(prefix, np.uint8)
    template.setflags(write=False)
    values = {
        f.name: (np.dtype(f.dtype), f.concrete_shape(dims)) for f in fields if f.name != "slot"
    }
    return RecordLayout(dtype, template, ("opcode", "length", "channel_id", *prefixes), values)


def as_raw(values: NDArray[Any]) -> NDArray[Any]:
    """View an array (T, ...) as T pieces of raw bytes.

    Copying those is one memcpy a slot, and no value can change on the way.

    Parameters
    ----------
    values
        Shape (T, ...). It is copied if a slot does not lie in one piece.

    Returns
    -------
    ndarray
        Shape (T,), of a void type; shape (T, 0) where there are no bytes. A view where it can be.
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
    """Type of raw bytes."""
    return np.dtype(f"V{nbytes}")


def raw_columns(rows: NDArray[Any], layout: RecordLayout) -> dict[str, NDArray[Any]]:
    """View each field in message records as raw bytes; fields without bytes are left out.

    Parameters
    ----------
    rows
        Records of type ``layout.dtype``, shape (T,).
    layout
        Their layout.

    Returns
    -------
    dict of ndarray
        Name -> view, shape (T,), of a void type.
    """
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
