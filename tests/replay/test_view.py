"""What viewers get: poses, images, views; Rerun reads our files to the last bit."""

from __future__ import annotations

import json
import re
import sys
import time
from collections import defaultdict
from datetime import timedelta
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
from hiersched.core.extras import MissingExtraError
from hiersched.log import TOPICS, LogDims, LogError, LogReader, LogWriter
from hiersched.log.schema import topics_in
from hiersched.replay.foxglove import foxglove_layout
from hiersched.replay.panels import PLOTS, Panels, lines_of, panels_of
from hiersched.replay.view import TIMELINE, show_in_rerun
from hiersched.replay.viewer_topics import (
    IMAGE_SLOTS,
    IMAGE_STEP,
    IMAGE_TOPIC,
    robot_poses,
    trails,
    write_viewer_topics,
)

LOG = "runs/evaluate/pf/seed11.mcap"
SMALL = {
    "compact": "runs/reference/arc/pf/seed21.mcap",
    "decisions": "train/ddpg/seed1.mcap",
    "robots": "runs/gain_study/krasovskii/adjusted/seed31.mcap",
}
"""Profile -> a log of it, in the study of the tests: 2 URLLC and 2 eMBB users."""
SHOWN = {
    "compact": {"/queue backlog_packets", "/delay late_packets", "/robots delay_steps",
                "/robots tracking_error_m", "/delay reward_urllc reward_embb"},
    "decisions": {"/delay backlog_urllc_packets backlog_embb_packets",
                  "/delay late_urllc_packets late_embb_packets", "/delay reward_urllc reward_embb"},
    "robots": {"/robots delay_steps", "/robots tracking_error_m"},
}  # fmt: skip
"""Profile -> what viewers plot of it at least."""


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


DRAWN = {"PoseInFrame", "PosesInFrame", "RawImage"}


def test_messages_are_those_of_the_public_schema(
    study: Path, tmp_path: Path, project_root: Path
) -> None:
    """Of the file's schema records, and of what protoc makes of the public schema."""
    write_viewer_topics(study / LOG, tmp_path / "viewer.mcap")
    with (tmp_path / "viewer.mcap").open("rb") as stream:
        schemas = make_reader(stream).get_summary().schemas.values()
    assert {schema.name.removeprefix("foxglove.") for schema in schemas} == DRAWN
    out, data = tmp_path / "set", project_root / "tests/log/data"
    arguments = ["", f"-I{data}", f"-I{Path(protoc.__file__).parent / '_proto'}"]
    arguments += ["--include_imports", f"--descriptor_set_out={out}", "foxglove.proto"]
    assert protoc.main(arguments) == 0
    public = messages_of(out.read_bytes())
    for schema in schemas:
        own = messages_of(schema.data)
        assert DRAWN | {"Pose", "Vector3", "Quaternion", "Timestamp"} == set(own)
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


def test_trails_by_hand() -> None:
    """Slots of 30 ms: a pose and a trail every third, as 0.1 s asks for; 3 s are 90 slots."""
    track = np.arange(200.0)[:, None, None] + np.array([[[0.0, 0.1, 0.2], [0.5, 0.6, 0.7]]])
    found = dict(trails(track, 0.03))
    assert list(found) == list(range(0, 200, 3))
    assert found[0].shape == (1, 2, 3)
    assert found[6][:, 1, 0].tolist() == [0.5, 3.5, 6.5]
    assert found[99][:, 0, 0].tolist() == list(range(9, 100, 3))
    (long,) = {index: trail.shape for index, trail in trails(track[:1], 5.0)}.items()
    assert long == (0, (1, 2, 3))


def flat(pose: Any) -> tuple[float, ...]:
    """Place in the plane, and orientation."""
    return pose.position.x, pose.position.y, pose.orientation.z, pose.orientation.w


def test_trails_lead_to_the_robots(messages: dict[str, list[Any]]) -> None:
    """In the files: every trail ends, at its slot, where the robot is, and begins with the run."""
    for robot in range(2):
        for track in ("pose", "reference"):
            poses = dict(messages[f"/robots/{robot}/{track}"])
            found = messages[f"/robots/{robot}/{track}_trail"]
            assert [slot for slot, _ in found] == [0, 10, 20, 30]
            for slot, trail in found:
                assert trail.frame_id == "plane"
                assert len(trail.poses) == 1 + slot // 10
                places = [flat(pose) for pose in trail.poses]
                ends = [flat(poses[0].pose), flat(poses[slot].pose)]
                assert [places[0], places[-1]] == ends


def test_messages_are_in_the_order_of_time(study: Path, tmp_path: Path) -> None:
    write_viewer_topics(study / LOG, tmp_path / "viewer.mcap")
    with (tmp_path / "viewer.mcap").open("rb") as stream:
        found = [m.log_time for *_, m in make_reader(stream).iter_messages(log_time_order=False)]
    assert found == sorted(found)
    assert found[0] == 0


def test_images_show_the_owner_of_every_prb(study: Path, messages: dict[str, list[Any]]) -> None:
    with LogReader(study / LOG) as log:
        owner = log.read("/allocation")["prb_owner"]
    assert [slot for slot, _ in messages[IMAGE_TOPIC]] == [0, IMAGE_STEP]
    _, image = messages[IMAGE_TOPIC][1]
    assert (image.width, image.height, image.encoding) == (IMAGE_SLOTS, 5, "rgb8")
    pixels = np.frombuffer(image.data, np.uint8).reshape(5, IMAGE_SLOTS, 3)
    colours = user_colours(2, 2)
    assert len({tuple(colour) for colour in colours.tolist()}) == 4
    for prb, slot in ((0, 0), (4, IMAGE_STEP), (2, 13)):
        column = IMAGE_SLOTS - 1 - IMAGE_STEP + slot
        assert pixels[prb, column].tolist() == colours[owner[slot, prb]].tolist()
    assert not pixels[:, : IMAGE_SLOTS - 1 - IMAGE_STEP].any()  # before the run


def test_users_can_be_told_apart_on_black() -> None:
    """By the contrast of WCAG 2 against Rerun's background, and among all users of `paper`."""

    def luminance(colour: Any) -> float:
        parts = np.asarray(colour) / 255.0
        linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    colours = user_colours(10, 10).tolist()
    assert len({tuple(colour) for colour in colours}) == 20
    black = luminance((13, 16, 17))
    assert min((luminance(c) + 0.05) / (black + 0.05) for c in colours) > 2.5


def full_panels() -> Panels:
    """All panels there are, of 2 URLLC and 3 eMBB users."""
    dims = LogDims(num_urllc=2, num_embb=3, num_prb=7)
    places = {"centre": (0.0, 1.0), "size": (4.0, 2.0)}
    tracks = ("pose", "reference", "set_point")
    return Panels(dims=dims, plots=PLOTS, tracks=tracks, has_image=True, has_events=True, **places)


def test_plots_are_of_fields_that_exist() -> None:
    dims = full_panels().dims
    for plot in PLOTS:
        lines = lines_of(plot, dims)
        fields = {f.name: f for f in TOPICS[plot.topic].fields}
        assert len(lines) == sum(np.prod(fields[name].sized(dims.sizes)) for name in plot.fields)
        spoken = {"packet": "packets", "sample": "samples", "1": ""}
        assert {spoken.get(u, u) for u in (fields[f].unit for f in plot.fields)} == {plot.unit}
        assert bool(plot.page_unit) == (plot.scale != 1.0)


def test_a_user_has_one_colour_in_every_plot() -> None:
    dims = full_panels().dims
    seen: dict[str, set[Any]] = defaultdict(set)
    for plot in PLOTS:
        for line in lines_of(plot, dims):
            seen[line.name.replace("robot", "URLLC")].add(line.colour)
    assert set(seen) == {"URLLC 0", "URLLC 1", "eMBB 2", "eMBB 3", "eMBB 4", "URLLC", "eMBB"}
    assert all(len(colours) == 1 for colours in seen.values())
    assert len(set.union(*seen.values())) == 7


def leaves(node: Any) -> list[str]:
    """Names of the panels in a layout."""
    if isinstance(node, str):
        return [node]
    assert set(node) == {"first", "second", "direction", "splitPercentage"}
    assert node["direction"] in ("row", "column")
    assert 0 < node["splitPercentage"] < 100
    return leaves(node["first"]) + leaves(node["second"])


# What the panels of Foxglove and Lichtblick read, by the sources of the latter (MPL-2.0):
# packages/suite-base/src/panels/Plot/utils/config.ts, Log/types.ts, ThreeDeeRender/IRenderer.ts,
# camera.ts, renderables/Poses.ts, PoseArrays.ts and Grids.ts. A key of another name is ignored in
# silence, so none may be there.
TITLES = {"foxglovePanelTitle", "lichtblickPanelTitle"}
KEYS = {
    "Plot": {"paths", "xAxisVal", "showLegend", "legendDisplay", "showPlotValuesInLegend",
             "isSynced", "showXAxisLabels", "showYAxisLabels", "sidebarDimension"},
    "path": {"value", "enabled", "color", "label", "timestampMethod", "showLine", "lineSize"},
    "3D": {"cameraState", "followTf", "followMode", "scene", "transforms", "topics", "layers"},
    "camera": {"perspective", "distance", "phi", "thetaOffset", "target", "targetOffset",
               "targetOrientation", "fovy", "near", "far"},
    "arrow": {"visible", "type", "arrowScale", "color"},
    "line": {"visible", "type", "lineWidth", "gradient"},
    "Image": {"imageMode"},
    "RosOut": {"topicToRender", "minLogLevel", "searchTerms"},
}  # fmt: skip


def test_foxglove_layout_has_the_form_that_is_read() -> None:
    layout = foxglove_layout(full_panels())
    assert sorted(leaves(layout["layout"])) == sorted(layout["configById"])
    for name, config in layout["configById"].items():
        kind, _, number = name.partition("!")
        assert set(config) == KEYS[kind] | TITLES, name
        assert number.isdigit()
        assert config["foxglovePanelTitle"] == config["lichtblickPanelTitle"] != ""
        for path in config.get("paths", []):
            assert set(path) == KEYS["path"]
            assert (path["timestampMethod"], config["xAxisVal"]) == ("receiveTime", "timestamp")
            topic, field, _ = re.fullmatch(r"(/\w+)\.(\w+)(\[\d+\])?", path["value"]).groups()
            assert field in {f.name for f in TOPICS[topic].fields}
    plane = layout["configById"]["3D!0"]
    assert set(plane["cameraState"]) == KEYS["camera"]
    for topic, settings in plane["topics"].items():
        assert set(settings) == KEYS["line" if topic.endswith("_trail") else "arrow"]
        assert settings["type"] == ("line" if topic.endswith("_trail") else "arrow")


def test_foxglove_shows_a_user_in_one_colour_everywhere() -> None:
    layout = foxglove_layout(full_panels())["configById"]
    colours = ["#" + bytes(colour).hex() for colour in user_colours(2, 3)]
    for config in layout.values():
        for path in config.get("paths", []):
            user = re.search(r"\[(\d+)\]$", path["value"])
            if user is not None:
                assert path["color"] == colours[int(user[1])]
                assert path["label"].endswith(f" {user[1]}")
    for topic, settings in layout["3D!0"]["topics"].items():
        robot = int(topic.split("/")[2])
        for colour in (settings["color"],) if "color" in settings else settings["gradient"]:
            assert re.fullmatch(rf"{colours[robot]}([0-9a-f]{{2}})?", colour)
        if topic.endswith("/pose"):
            assert settings["color"] == colours[robot]


@pytest.mark.parametrize("name", [LOG, *SMALL.values()])
def test_foxglove_finds_everything_in_the_files(study: Path, tmp_path: Path, name: str) -> None:
    """With the stock reader: a number for every path, a message of the right kind to be drawn."""
    log = study / name
    assert main(["export", str(log), "--viewer", "--out", str(tmp_path)]) == 0
    messages: dict[str, Any] = {}
    kinds: dict[str, str] = {}
    for file in (log, tmp_path / "viewer.mcap"):
        with file.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
            for schema, channel, _, decoded in reader.iter_decoded_messages():
                messages[channel.topic], kinds[channel.topic] = decoded, schema.name
    layout = json.loads((tmp_path / "foxglove.json").read_text(encoding="utf-8"))["configById"]
    assert layout
    for panel, config in layout.items():
        for path in config.get("paths", []):
            topic, field, place = re.fullmatch(
                r"([^.]+)\.(\w+)(?:\[(\d+)\])?", path["value"]
            ).groups()
            value = getattr(messages[topic], field)
            assert isinstance(value if place is None else value[int(place)], int | float)
        for topic in config.get("topics", []):
            many = "Poses" if topic.endswith("_trail") else "Pose"
            assert kinds[topic] == f"foxglove.{many}InFrame"
        if panel == "Image!0":
            assert kinds[config["imageMode"]["imageTopic"]] == "foxglove.RawImage"
        if panel == "RosOut!0":
            assert kinds[config["topicToRender"]] == "foxglove.Log"


@pytest.mark.parametrize("profile", SMALL)
def test_small_logs_are_shown_as_far_as_they_go(
    study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], profile: str
) -> None:
    log = study / SMALL[profile]
    with LogReader(log) as reader:
        assert reader.profile == profile
        panels = panels_of(reader)
        for plot in panels.plots:
            assert set(plot.fields) <= set(reader.fields(plot.topic))
    assert {" ".join((plot.topic, *plot.fields)) for plot in panels.plots} >= SHOWN[profile]
    assert panels.tracks == ()
    assert panels.has_image == (profile != "robots")
    assert sorted(plot for row in panels.rows for plot in row) == sorted(panels.plots)
    assert sum(panels.has_legend(plot) for plot in panels.plots if len(plot.fields) == 1) <= 1
    assert main(["export", str(log), "--viewer", "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().err
    assert f"profile {profile}" in said
    lacking = set(said.partition("leaves out: ")[2].partition(".")[0].split(", "))
    assert "Gain in force" in lacking
    assert not lacking & {plot.title for plot in panels.plots}
    assert ("Queue" in lacking) == (profile == "decisions")
    assert f"hiersched replay {log} --out full.mcap" in said


def test_a_log_that_says_so_little_is_shown_in_full_at_the_replay(
    study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What the message tells to type has all panels."""
    full = tmp_path / "full.mcap"
    assert main(["replay", str(study / SMALL["compact"]), "--out", str(full)]) == 0
    capsys.readouterr()
    assert main(["export", str(full), "--viewer", "--out", str(tmp_path / "v")]) == 0
    assert capsys.readouterr().err == ""
    with LogReader(full) as log:
        assert panels_of(log).tracks == ("pose", "reference")


def test_what_is_always_0_takes_no_panel(study: Path) -> None:
    with LogReader(study / LOG) as log:
        panels = panels_of(log)
        superseded = log.read("/queue", ["superseded_packets"])["superseded_packets"]
    assert not superseded.any()
    assert not {"superseded_packets", "set_point_age_s"} & {p.fields[0] for p in panels.plots}
    assert "set_point" not in panels.tracks  # robots know their reference


def test_a_log_without_slots_shows_nothing(study: Path, tmp_path: Path) -> None:
    with LogReader(study / LOG) as log:
        whose = log.dims, log.profile, log.metadata
    with LogWriter(tmp_path / "a.mcap", *whose, {}, slot_ns=10_000_000):
        pass
    with LogReader(tmp_path / "a.mcap") as log:
        with pytest.raises(LogError, match=r"a\.mcap.*has no slots"):
            panels_of(log)


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
    with pytest.raises(MissingExtraError, match=r"pip install 'hiersched\[viewer\]'"):
        show_in_rerun(study / LOG)


def test_a_recording_is_written_in_full_or_not_at_all(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    log = tmp_path / "run.mcap"
    log.write_bytes((study / LOG).read_bytes())
    before = log.read_bytes()
    for words in (
        ["view", str(log), "--save", str(log)],
        ["report", str(log), "--out", str(log)],
        ["export", str(log), "--viewer", "--out", str(tmp_path / "v")],
    ):
        if words[0] == "export":
            (tmp_path / "v").mkdir()
            (tmp_path / "v/viewer.mcap").symlink_to(log)
        assert main([*words, "--overwrite"]) == 2, words
        assert "is the file to be read" in capsys.readouterr().err
    assert log.read_bytes() == before
    (tmp_path / "a.rrd").write_bytes(b"kept")
    with pytest.raises(FileExistsError, match=r"a\.rrd: exists; --overwrite replaces it"):
        show_in_rerun(log, tmp_path / "a.rrd")
    pytest.importorskip("rerun.chunk", reason="needs rerun-sdk (the extra viewer)")
    with monkeypatch.context() as broken:
        broken.setattr("hiersched.replay.view.write_viewer_topics", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            show_in_rerun(log, tmp_path / "a.rrd", overwrite=True)
    assert (tmp_path / "a.rrd").read_bytes() == b"kept"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.rrd", "run.mcap", "v"]
    show_in_rerun(log, tmp_path / "a.rrd", overwrite=True)
    assert (tmp_path / "a.rrd").read_bytes() != b"kept"


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


@pytest.fixture(scope="module")
def recordings(study: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What `hiersched view --save` writes, by profile."""
    chunk = pytest.importorskip("rerun.chunk", reason="needs rerun-sdk (the extra viewer)")
    folder = tmp_path_factory.mktemp("rerun")
    found = {}
    for profile, name in {"full": LOG, **SMALL}.items():
        show_in_rerun(study / name, folder / f"{profile}.rrd")
        found[profile] = chunk.RrdReader(folder / f"{profile}.rrd")
    assert sorted(p.name for p in folder.iterdir()) == sorted(f"{p}.rrd" for p in found)
    return found


def column(reader: Any, name: str, store: Any = None) -> dict[str, list[Any]]:
    """Read a component of a recording or a blueprint, by entity: all its rows."""
    found: dict[str, list[Any]] = defaultdict(list)
    for part in reader.stream(store=store) if store else reader.stream():
        batch = part.to_record_batch()
        if name in batch.schema.names:
            found[str(part.entity_path)] += batch.column(name).to_pylist()
    return found


def test_rerun_recording_has_what_is_drawn(recordings: dict[str, Any]) -> None:
    parts = list(recordings["full"].stream())
    drawn = {IMAGE_TOPIC, "/robots/0/pose", "/robots/1/reference", "/robots/1/pose_trail"}
    assert {*topics_in("full"), "/events", *drawn} <= {str(part.entity_path) for part in parts}


def test_rerun_begins_at_0(recordings: dict[str, Any]) -> None:
    """Time is a duration, not a date in 1970; trails are at the times of the log."""
    for reader in recordings.values():
        times = column(reader, TIMELINE)
        assert all(isinstance(t, timedelta) for x in times.values() for t in x)
        assert min(t.total_seconds() for x in times.values() for t in x) == 0.0
    full = column(recordings["full"], TIMELINE)
    trail = [t.total_seconds() for t in full["/robots/0/pose_trail"]]
    assert trail == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert set(full["/robots/0/pose_trail"]) <= set(full["/robots"])


def packed(colour: Any, opacity: int = 255) -> int:
    return int.from_bytes(bytes([*colour, opacity]), "big")


@pytest.mark.parametrize("profile", ["full", *SMALL])
def test_rerun_plots_users_in_their_colours(
    recordings: dict[str, Any], study: Path, profile: str
) -> None:
    """The lines of the blueprint in the file are those of the panels, name and colour."""
    reader = recordings[profile]
    (store,) = reader.blueprints()
    names, colours = (column(reader, f"SeriesLines:{name}", store) for name in ("names", "colors"))
    assert set(names) == set(colours)
    got = sorted(
        (name, colour)
        for entity in names
        for name, colour in zip(names[entity][0], colours[entity][0], strict=True)
    )
    with LogReader(study / {"full": LOG, **SMALL}[profile]) as log:
        panels = panels_of(log)
    lines = [line for plot in panels.plots for line in lines_of(plot, panels.dims)]
    assert got == sorted((line.name, packed(line.colour)) for line in lines)
    titles = {row[0] for rows in column(reader, "ViewBlueprint:display_name", store).values()
              for row in rows}  # fmt: skip
    assert {plot.heading for plot in panels.plots} <= titles


def test_rerun_draws_robots_and_trails_in_their_users_colours(recordings: dict[str, Any]) -> None:
    marks = column(recordings["full"], "Points3D:colors")
    trails = column(recordings["full"], "LineStrips3D:colors")
    for robot, colour in enumerate(user_colours(2, 2)[:2]):
        assert marks[f"/robots/{robot}/pose"] == [[packed(colour)]]
        assert trails[f"/robots/{robot}/pose_trail"] == [[packed(colour)]]
        (pale,) = trails[f"/robots/{robot}/reference_trail"][0]
        assert pale not in (packed(colour), packed(user_colours(2, 2)[1 - robot]))
        assert marks[f"/robots/{robot}/reference"] == [[pale]]


def test_rerun_draws_trails_where_the_robots_were(recordings: dict[str, Any], study: Path) -> None:
    with LogReader(study / LOG) as log:
        robots = log.read("/robots", ["state", "reference"])
    poses = robot_poses(robots["state"], robots["reference"])
    strips = column(recordings["full"], "LineStrips3D:strips")["/robots/1/pose_trail"]
    assert [len(strip[0]) for strip in strips] == [1, 2, 3, 4]
    assert np.array(strips[3][0])[:, :2] == pytest.approx(poses[:31:10, 1, :2], abs=1e-6)
    assert np.array(strips[3][0])[:, 2] == pytest.approx(np.zeros(4))


@pytest.mark.nightly
def test_a_headless_rerun_opens_every_view(study: Path, tmp_path: Path) -> None:
    """No view reports that something cannot be shown; the picture is more than a background."""
    experimental = pytest.importorskip("rerun.experimental", reason="needs rerun-sdk")
    image = pytest.importorskip("PIL.Image")
    show_in_rerun(study / LOG, tmp_path / "a.rrd")
    binary = Path(sys.executable).with_name("rerun")
    try:
        viewer = experimental.ViewerClient.spawn(
            headless=True, port=9877, hide_welcome_screen=True, executable_path=str(binary)
        )
    except Exception as error:  # whatever it is: without a graphics driver there is no viewer
        pytest.skip(f"no headless Rerun here: {error}")
    with viewer:
        viewer.open(str(tmp_path / "a.rrd"))
        viewer.set_time(TIMELINE, duration=0.3, play_state="paused")
        time.sleep(15)  # it loads in the background, and says nowhere that it is done
        views = {view.name: view for view in viewer.get_state().views}
        (tmp_path / "a.png").write_bytes(viewer.take_screenshot())
    with LogReader(study / LOG) as log:
        titles = {plot.heading for plot in panels_of(log).plots}
    assert titles <= set(views)
    assert [view.name for view in views.values() if view.reports] == []
    pixels = np.asarray(image.open(tmp_path / "a.png").convert("RGB")).reshape(-1, 3)
    seen = {tuple(pixel) for pixel in np.unique(pixels, axis=0).tolist()}
    for colour in user_colours(2, 2).tolist():
        assert tuple(colour) in seen
