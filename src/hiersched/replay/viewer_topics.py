"""What viewers draw and a log does not have: poses in the plane, the allocation as an image."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from hiersched.core.colours import user_colours
from hiersched.log import LogError, LogReader
from hiersched.log.schema import describe, message_class

FRAME = "plane"
IMAGE_TOPIC = "/allocation/image"
IMAGE_SLOTS = 100
"""Width of an image of the allocation [slots]: one pixel a slot and PRB."""

_LIBRARY = "hiersched-viewer/1"
_TIME = "google.protobuf.Timestamp timestamp"
_MESSAGES = {  # numbers as in the public schemas of Foxglove
    "foxglove.Vector3": ("double x", "double y", "double z"),
    "foxglove.Quaternion": ("double x", "double y", "double z", "double w"),
    "foxglove.Pose": ("foxglove.Vector3 position", "foxglove.Quaternion orientation"),
    "foxglove.PoseInFrame": (_TIME, "string frame_id", "foxglove.Pose pose"),
    "foxglove.RawImage": (
        *(_TIME, "fixed32 width", "fixed32 height", "string encoding", "fixed32 step"),
        *("bytes data", "string frame_id"),
    ),
}


class PoseTopics(NamedTuple):
    """Topics of one robot's poses."""

    pose: str
    reference: str  # the newest set-point
    set_point: str  # the one in force; only in logs of robots whose set-points are late


def pose_topics(num_robots: int) -> list[PoseTopics]:
    """Topics of each robot's poses."""
    return [
        PoseTopics(*(f"/robots/{i}/{name}" for name in PoseTopics._fields))
        for i in range(num_robots)
    ]


def robot_poses(state: NDArray[np.float64], reference: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses x, y, theta in the plane, shape (..., 3), from errors in the frame of the reference.

    `state`, e_x, e_y [m], e_theta [rad] first, and `reference`, x, y [m], theta [rad] first, have
    shape (..., 5).
    """
    cos, sin = np.cos(reference[..., 2]), np.sin(reference[..., 2])
    return np.stack(
        (
            reference[..., 0] + cos * state[..., 0] - sin * state[..., 1],
            reference[..., 1] + sin * state[..., 0] + cos * state[..., 1],
            reference[..., 2] + state[..., 2],
        ),
        axis=-1,
    )


@cache
def _descriptors() -> bytes:
    return describe("foxglove/Viewer.proto", _MESSAGES)


def write_viewer_topics(path: str | os.PathLike[str], out: str | os.PathLike[str]) -> None:
    """Write an MCAP file to open beside the log: poses, references, images of the allocation.

    Poses are `foxglove.PoseInFrame`, at the end of each slot and with its log time; images are
    `foxglove.RawImage`, of the last `IMAGE_SLOTS` slots, time to the right and PRBs downwards. The
    file appears whole or not at all; LogError if the log is damaged, or does not have what is
    drawn.
    """
    target = Path(out)
    part = target.with_name(target.name + ".part")
    with LogReader(path) as log, open(part, "wb") as stream:
        _write(log, stream)
    os.replace(part, target)


def _write(log: LogReader, stream: IO[bytes]) -> None:
    writer = Writer(stream, compression=CompressionType.ZSTD, enable_data_crcs=True)
    writer.start(library=_LIBRARY)
    schemas = {
        name: writer.register_schema(name, "protobuf", _descriptors())
        for name in ("foxglove.PoseInFrame", "foxglove.RawImage")
    }
    channels: dict[str, int] = {}
    for topic, message, slot in _messages(log):
        if topic not in channels:
            schema = schemas[message.DESCRIPTOR.full_name]
            channels[topic] = writer.register_channel(topic, "protobuf", schema)
        time = slot * log.slot_ns
        message.timestamp.seconds, message.timestamp.nanos = divmod(time, 1_000_000_000)
        data = message.SerializeToString(deterministic=True)
        writer.add_message(channels[topic], time, data, time, slot)
    writer.finish()  # type: ignore[no-untyped-call]


def _messages(log: LogReader) -> Iterator[tuple[str, Any, int]]:
    """Yield topic, message without its time, and slot."""
    if log.dims.num_posed:
        yield from _pose_messages(log)
    owner = log.read("/allocation", ["prb_owner"])
    colours = user_colours(log.dims.num_urllc, log.dims.num_embb)
    for start in range(0, len(owner["slot"]), IMAGE_SLOTS):
        part = owner["prb_owner"][start : start + IMAGE_SLOTS]
        last = int(owner["slot"][start + len(part) - 1])
        yield IMAGE_TOPIC, _image(colours[part.T]), last


def _pose_messages(log: LogReader) -> Iterator[tuple[str, Any, int]]:
    if "/robots" not in log.topics or not {"state", "reference"} <= {*log.known_fields("/robots")}:
        what = (
            f"poses need state and reference, which the profile {log.profile} leaves out "
            f"(hiersched replay {log.path} --out FULL.mcap writes the whole run)"
        )
        raise LogError(log.path, 0, what)
    known = [name for name in ("set_point",) if name in log.known_fields("/robots")]
    robots = log.read("/robots", ["state", "reference", *known])
    poses = [robot_poses(robots["state"], robots["reference"]), robots["reference"][..., :3]]
    poses += [robots[name] for name in known if robots[name].any()]
    for index, slot in enumerate(robots["slot"].tolist()):
        for robot, topics in enumerate(pose_topics(log.dims.num_posed)):
            for topic, pose in zip(topics, poses, strict=False):
                yield topic, _pose(*pose[index, robot].tolist()), slot


def _pose(x: float, y: float, theta: float) -> Any:
    message = message_class(_descriptors(), "foxglove.PoseInFrame")(frame_id=FRAME)
    message.pose.position.x, message.pose.position.y = x, y
    message.pose.orientation.z = math.sin(0.5 * theta)
    message.pose.orientation.w = math.cos(0.5 * theta)
    return message


def _image(rgb: NDArray[np.uint8]) -> Any:
    """Make an image of pixels, shape (height, width, 3)."""
    height, width = rgb.shape[:2]
    return message_class(_descriptors(), "foxglove.RawImage")(
        frame_id="allocation",
        width=width,
        height=height,
        encoding="rgb8",
        step=3 * width,
        data=np.ascontiguousarray(rgb).tobytes(),
    )
