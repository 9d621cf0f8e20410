"""What viewers get: poses, images, views; Rerun reads our files to the last bit."""

from __future__ import annotations

import json
import re
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from grpc_tools import protoc
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from hiersched.cli import main
from hiersched.core.colours import user_colours
from hiersched.log import TOPICS, LogDims, LogReader
from hiersched.log.schema import topics_in
from hiersched.replay.view import PLOTS, foxglove_layout, series_names, show_in_rerun
from hiersched.replay.viewer_topics import (
    IMAGE_SLOTS,
    IMAGE_TOPIC,
    robot_poses,
    write_viewer_topics,
)

LOG = "runs/evaluate/pf/seed11.mcap"


@pytest.mark.parametrize(
    ("state", "reference", "pose"),
    [
        ((0.1, 0.2, 0.3), (1, 2, 0), (1.1, 2.2, 0.3)),  # reference looks along x
        ((0.1, 0.2, 0.3), (1, 2, np.pi / 2), (0.8, 2.1, np.pi / 2 + 0.3)),  # along y
        ((0.0, -0.5, 0.0), (0, 0, np.pi), (0.0, 0.5, np.pi)),
    ],
)
def test_poses_by_hand(state: Any, reference: Any, pose: Any) -> None:
    got = robot_poses(np.array([*state, 9.0, 9.0]), np.array([*reference, 1.0, 0.0]))
    assert got == pytest.approx(pose)


@pytest.fixture(scope="module")
def messages(study: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    """The viewer's messages by topic, by the stock reader."""
    path = tmp_path_factory.mktemp("viewer") / "viewer.mcap"
    write_viewer_topics(study / LOG, path)
    found: dict[str, list[Any]] = defaultdict(list)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            stamp = decoded.timestamp
            assert message.log_time == stamp.seconds * 10**9 + stamp.nanos
            found[channel.topic].append((message.sequence, decoded))
    return found


def test_messages_are_those_of_the_public_schema(
    study: Path, tmp_path: Path, project_root: Path
) -> None:
    """Of the file's schema records, and of what protoc makes of the public schema."""
    write_viewer_topics(study / LOG, tmp_path / "viewer.mcap")
    with (tmp_path / "viewer.mcap").open("rb") as stream:
        schemas = make_reader(stream).get_summary().schemas.values()
    assert {schema.name for schema in schemas} == {"foxglove.PoseInFrame", "foxglove.RawImage"}
    out, data = tmp_path / "set", project_root / "tests/log/data"
    arguments = ["", f"-I{data}", f"-I{Path(protoc.__file__).parent / '_proto'}"]
    arguments += ["--include_imports", f"--descriptor_set_out={out}", "foxglove.proto"]
    assert protoc.main(arguments) == 0
    public = messages_of(out.read_bytes())
    for schema in schemas:
        own = messages_of(schema.data)
        assert {"PoseInFrame", "RawImage", "Pose", "Vector3", "Quaternion", "Timestamp"} == set(own)
        assert own == {name: public[name] for name in own}


def messages_of(descriptors: bytes) -> dict[str, Any]:
    files = FileDescriptorSet.FromString(descriptors).file
    return {message.name: message for file in files for message in file.message_type}


def test_poses_are_those_of_the_log(study: Path, messages: dict[str, list[Any]]) -> None:
    with LogReader(study / LOG) as log:
        robots = log.read("/robots")
    for robot in range(2):
        pose, reference = (messages[f"/robots/{robot}/{name}"] for name in ("pose", "reference"))
        assert [slot for slot, _ in pose] == [slot for slot, _ in reference] == list(range(40))
        for slot in (0, 17, 39):
            a, b = pose[slot][1].pose, reference[slot][1].pose
            x, y, theta = robots["reference"][slot, robot, :3]
            assert (b.position.x, b.position.y) == (x, y)
            turn = complex(b.orientation.w, b.orientation.z) ** 2
            assert turn == pytest.approx(complex(np.cos(theta), np.sin(theta)))
            error = robots["state"][slot, robot]
            distance = np.hypot(a.position.x - x, a.position.y - y)
            assert distance == pytest.approx(np.hypot(error[0], error[1]))
            assert distance > 0
        assert pose[0][1].frame_id == reference[0][1].frame_id == "plane"


def test_images_show_the_owner_of_every_prb(study: Path, messages: dict[str, list[Any]]) -> None:
    with LogReader(study / LOG) as log:
        owner = log.read("/allocation")["prb_owner"]
    ((slot, image),) = messages[IMAGE_TOPIC]
    assert (slot, image.width, image.height, image.encoding) == (39, 40, 5, "rgb8")
    assert image.width <= IMAGE_SLOTS
    pixels = np.frombuffer(image.data, np.uint8).reshape(5, 40, 3)
    colours = user_colours(2, 2)
    assert len({tuple(colour) for colour in colours.tolist()}) == 4
    for prb, column in ((0, 0), (4, 39), (2, 13)):
        assert pixels[prb, column].tolist() == colours[owner[column, prb]].tolist()


def test_plots_are_of_fields_that_exist() -> None:
    dims = LogDims(num_urllc=2, num_embb=3, num_prb=7)
    for plot in PLOTS:
        field = next(f for f in TOPICS[plot.topic].fields if f.name == plot.field)
        assert len(series_names(plot, dims)) == np.prod(field.sized(dims.sizes))


def test_foxglove_layout_names_panels_and_fields_that_exist() -> None:
    layout = foxglove_layout(LogDims(num_urllc=2, num_embb=3, num_prb=7))

    def leaves(node: Any) -> list[str]:
        if isinstance(node, str):
            return [node]
        assert set(node) == {"first", "second", "direction", "splitPercentage"}
        return leaves(node["first"]) + leaves(node["second"])

    assert sorted(leaves(layout["layout"])) == sorted(layout["configById"])
    for config in layout["configById"].values():
        for path in config.get("paths", []):
            topic, field, _ = re.fullmatch(r"(/\w+)\.(\w+)\[(\d+)\]", path["value"]).groups()
            assert field in {f.name for f in TOPICS[topic].fields}


def test_poses_need_the_full_profile(
    study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder, profile in (("train", "decisions"), ("runs/reference", "compact")):
        log = next((study / folder).rglob("*.mcap"))
        assert main(["export", str(log), "--viewer", "--out", str(tmp_path / "out")]) == 2
        wanted = f"poses need state and reference, which the profile {profile} leaves out"
        assert wanted in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.mcap"))


def test_export_for_viewers(study: Path, tmp_path: Path) -> None:
    assert main(["export", str(study / LOG), "--viewer", "--out", str(tmp_path / "v")]) == 0
    assert sorted(p.name for p in (tmp_path / "v").iterdir()) == ["foxglove.json", "viewer.mcap"]
    layout = json.loads((tmp_path / "v/foxglove.json").read_text(encoding="utf-8"))
    assert layout["configById"]["Image!0"]["imageMode"]["imageTopic"] == IMAGE_TOPIC


def test_view_without_rerun_says_what_to_install(
    study: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["view", str(study / LOG)]) == 2
    assert "pip install 'hiersched[viewer]'" in capsys.readouterr().err


def test_rerun_reads_every_bit(study: Path) -> None:
    chunk = pytest.importorskip("rerun.chunk", reason="needs rerun-sdk (the extra viewer)")
    seen: dict[str, dict[str, list[Any]]] = defaultdict(lambda: defaultdict(list))
    for part in chunk.McapReader(study / LOG).stream():
        topic = str(part.entity_path)
        if topic not in TOPICS:
            continue
        batch = part.to_record_batch()
        name = f"{TOPICS[topic].message}:message"
        if name in batch.schema.names:
            for row in batch.column(name).to_pylist():
                for field, value in row[0].items():
                    seen[topic][field].append(value)
    with LogReader(study / LOG) as log:
        for topic in log.topics:
            for field, values in log.read(topic).items():
                back = np.array(seen[topic][field], values.dtype).reshape(values.shape)
                assert back.tobytes() == values.tobytes(), (topic, field)


def test_rerun_recording_has_the_views(study: Path, tmp_path: Path) -> None:
    chunk = pytest.importorskip("rerun.chunk", reason="needs rerun-sdk (the extra viewer)")
    show_in_rerun(study / LOG, tmp_path / "a.rrd")
    assert [p.name for p in tmp_path.iterdir()] == ["a.rrd"]
    entities = {str(part.entity_path) for part in chunk.RrdReader(tmp_path / "a.rrd").stream()}
    assert {
        *topics_in("full"),
        "/events",
        IMAGE_TOPIC,
        "/robots/0/pose",
        "/robots/1/reference",
    } <= entities
