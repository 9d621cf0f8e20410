"""What viewers draw and a log does not have: poses, trails, the allocation as an image."""

from __future__ import annotations

import heapq
import math
import os
from collections.abc import Iterator, Sequence
from functools import cache
from operator import itemgetter
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from hiersched.core.colours import user_colours
from hiersched.log import LogReader
from hiersched.log.schema import describe, message_class

FRAME = "plane"
IMAGE_TOPIC = "/allocation/image"
IMAGE_SLOTS = 100
"""Width of an image of the allocation [slots]: one pixel a slot and PRB, black before the first."""
IMAGE_STEP = 20
"""Between two images [slots]."""

TRAIL_S = 3.0
"""Length of the trail behind a robot [s]."""
TRAIL_STEP_S = 0.1
"""Between two poses of a trail, and between two trails [s]."""

_LIBRARY = "hiersched-viewer/2"
_TIME = "google.protobuf.Timestamp timestamp"
_MESSAGES = {  # numbers as in the public schemas of Foxglove
    "foxglove.Vector3": ("double x", "double y", "double z"),
    "foxglove.Quaternion": ("double x", "double y", "double z", "double w"),
    "foxglove.Pose": ("foxglove.Vector3 position", "foxglove.Quaternion orientation"),
    "foxglove.PoseInFrame": (_TIME, "string frame_id", "foxglove.Pose pose"),
    "foxglove.PosesInFrame": (_TIME, "string frame_id", "repeated foxglove.Pose poses"),
    "foxglove.RawImage": (
        *(_TIME, "fixed32 width", "fixed32 height", "string encoding", "fixed32 step"),
        *("bytes data", "string frame_id"),
    ),
}


TRACKS = ("pose", "reference", "set_point")
"""What is drawn of a robot: itself, the newest set-point, and the set-point in force."""
TRAIL_Z_M = {"pose": 0.0, "reference": -0.02, "set_point": -0.01}
"""Heights of trails: the robot's is drawn over the others, on which it mostly lies."""


def track_topic(robot: int, track: str) -> str:
    """Topic of the poses of one of a robot's `TRACKS`."""
    return f"/robots/{robot}/{track}"


def trail_topic(robot: int, track: str) -> str:
    """Topic of the trails of one of a robot's `TRACKS`."""
    return f"/robots/{robot}/{track}_trail"


def read_tracks(log: LogReader) -> dict[str, NDArray[np.float64]]:
    """Read what can be drawn of the robots, by `TRACKS`: x, y [m], theta [rad], shape (T, R, 3).

    Nothing for robots without a pose, and where the log's profile leaves out their states; no
    set-point in force where robots know their reference. LogError if the log is damaged.
    """
    known = log.known_fields("/robots") if "/robots" in log.topics else ()
    if not log.dims.num_posed or not {"state", "reference"} <= {*known}:
        return {}
    set_point = [name for name in ("set_point",) if name in known]
    robots = log.read("/robots", ["state", "reference", *set_point])
    tracks = {
        "pose": robot_poses(robots["state"], robots["reference"]),
        "reference": robots["reference"][..., :3],
    }
    return tracks | {name: robots[name] for name in set_point if robots[name].any()}


def trails(track: NDArray[np.float64], slot_s: float) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Yield index of a slot and the poses that lead to it, shape (n, R, 3), the oldest first.

    `track` has shape (T, R, 3), `slot_s` is the length of a slot [s]. A trail is `TRAIL_S` long and
    has a pose every `TRAIL_STEP_S`; there is a trail every so often.
    """
    step = max(1, round(TRAIL_STEP_S / slot_s))
    length = step * round(TRAIL_S / TRAIL_STEP_S)
    for last in range(0, len(track), step):
        yield last, track[max(0, last - length) : last + 1 : step]


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
    """Write an MCAP file to open beside the log: poses, trails, images of the allocation.

    Poses are `foxglove.PoseInFrame`, at the end of each slot and with its log time; trails are
    `foxglove.PosesInFrame`; images are `foxglove.RawImage`, of the last `IMAGE_SLOTS` slots, time
    to the right and PRBs downwards. Topics for which the log does not have the fields are left out.
    The file appears whole or not at all; LogError if the log is damaged.
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
        for name in ("foxglove.PoseInFrame", "foxglove.PosesInFrame", "foxglove.RawImage")
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
    """Yield topic, message without its time, and slot, in the order of time."""
    streams = [_image_messages(log)] if has_owners(log) else []
    if tracks := read_tracks(log):
        slots = log.read("/robots", [])["slot"].tolist()
        for name, track in tracks.items():
            streams.append(_pose_messages(name, track, slots))
            streams.append(_trail_messages(name, track, slots, log.slot_ns * 1e-9))
    return heapq.merge(*streams, key=itemgetter(2))


def has_owners(log: LogReader) -> bool:
    """Whether a log says who had which PRB."""
    return "/allocation" in log.topics and "prb_owner" in log.known_fields("/allocation")


def _image_messages(log: LogReader) -> Iterator[tuple[str, Any, int]]:
    owner = log.read("/allocation", ["prb_owner"])
    colours = user_colours(log.dims.num_urllc, log.dims.num_embb)
    for last in range(0, len(owner["slot"]), IMAGE_STEP):
        part = owner["prb_owner"][max(0, last + 1 - IMAGE_SLOTS) : last + 1]
        pixels = np.zeros((log.dims.num_prb, IMAGE_SLOTS, 3), np.uint8)
        pixels[:, IMAGE_SLOTS - len(part) :] = colours[part.T]
        yield IMAGE_TOPIC, _image(pixels), int(owner["slot"][last])


def _pose_messages(
    name: str, track: NDArray[np.float64], slots: Sequence[int]
) -> Iterator[tuple[str, Any, int]]:
    of_pose = message_class(_descriptors(), "foxglove.PoseInFrame")
    for slot, poses in zip(slots, track, strict=True):
        for robot, pose in enumerate(poses.tolist()):
            message = of_pose(frame_id=FRAME)
            _set_pose(message.pose, *pose)
            yield track_topic(robot, name), message, slot


def _trail_messages(
    name: str, track: NDArray[np.float64], slots: Sequence[int], slot_s: float
) -> Iterator[tuple[str, Any, int]]:
    of_trail = message_class(_descriptors(), "foxglove.PosesInFrame")
    for index, trail in trails(track, slot_s):
        for robot, poses in enumerate(trail.swapaxes(0, 1).tolist()):
            message = of_trail(frame_id=FRAME)
            for pose in poses:
                _set_pose(message.poses.add(), *pose)
                message.poses[-1].position.z = TRAIL_Z_M[name]
            yield trail_topic(robot, name), message, slots[index]


def _set_pose(pose: Any, x: float, y: float, theta: float) -> None:
    pose.position.x, pose.position.y = x, y
    pose.orientation.z, pose.orientation.w = math.sin(0.5 * theta), math.cos(0.5 * theta)


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
