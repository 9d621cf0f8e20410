"""One table of fields: what is made of it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from grpc_tools import protoc

from hiersched.cli import main
from hiersched.core.fields import FIELDS, LETTERS, PROFILES, TOPIC_MEANINGS
from hiersched.log import SCHEMA_VERSION, TOPICS, LogDims, field_table, proto_source
from hiersched.log.layout import as_raw
from hiersched.log.schema import descriptors, event_descriptors, topics_in
from hiersched.simulator.record import SlotLayout

DATA = Path(__file__).with_name("data")


def compiled(folder: Path, source: str) -> FileDescriptorSet:
    """What protoc makes of a file."""
    out = folder / "set.binpb"
    wellknown = Path(protoc.__file__).parent / "_proto"
    arguments = ["", f"-I{folder}", f"-I{wellknown}", "--include_imports"]
    assert protoc.main([*arguments, f"--descriptor_set_out={out}", source]) == 0
    return FileDescriptorSet.FromString(out.read_bytes())


def test_descriptors_are_what_protoc_makes_of_the_text(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert main(["schema"]) == 0
    text = capsys.readouterr().out
    assert text == proto_source()
    (tmp_path / "hiersched.proto").write_text(text, encoding="utf-8")
    set_of_protoc = compiled(tmp_path, "hiersched.proto")
    assert set_of_protoc == FileDescriptorSet.FromString(descriptors())
    assert f"Schema version {SCHEMA_VERSION}." in text
    for field in FIELDS:
        (line,) = re.findall(rf".* {field.name} = \d+;  // (.*)", text)
        assert all(part in line for part in (field.unit, field.meaning, *field.profiles))


def test_events_are_those_of_the_public_schema(tmp_path: Path) -> None:
    (tmp_path / "foxglove.proto").write_bytes((DATA / "foxglove.proto").read_bytes())
    public, own = (
        {message.name: message for file in files.file for message in file.message_type}
        for files in (
            compiled(tmp_path, "foxglove.proto"),
            FileDescriptorSet.FromString(event_descriptors()),
        )
    )
    assert set(own) == {"Log", "Timestamp"}
    assert own == {name: public[name] for name in own}


def test_the_page_on_logs_has_the_table(project_root: Path) -> None:
    text = (project_root / "docs/log.md").read_text(encoding="utf-8")
    assert field_table() in text, "docs/log.md: the table of fields is not that of field_table()"
    assert all(f"`{letter}` {meaning}" in text for letter, meaning in LETTERS.items())
    assert len(field_table().splitlines()) == len(FIELDS) + 2


def test_topics_table_is_the_record_of_the_simulator() -> None:
    """`write_block` takes what the simulator hands out, without a conversion."""
    dims = LogDims(num_urllc=3, num_embb=2, num_prb=7, num_model_values=8)
    layout = SlotLayout(num_users=5, num_robots=3, num_prb=7, num_model_values=8)
    record = layout.record(1, 2).environment(0)
    table = {
        field.name: (np.dtype(field.dtype), (2, *field.sized(dims.sizes)))
        for topic in topics_in("full", 8).values()
        for field in topic.fields_in("full")
    }
    assert {name: (values.dtype, values.shape) for name, values in record.items()} == table


def test_raw_bytes_are_views_wherever_a_slot_lies_in_one_piece() -> None:
    rows = np.arange(5 * 64, dtype=np.uint8).reshape(5, 64)
    whole = np.arange(60.0).reshape(5, 3, 4)
    views = [
        whole,
        whole[:, 1:3],
        whole[::2],
        whole[:, 1, 2],
        rows.view(np.dtype([("a", "<f4", 3), ("b", "<f8", (2, 3)), ("c", "V4")]))[:, 0]["b"],
    ]
    copies = [whole[:, :, ::2], np.asfortranarray(whole), whole[:, :, 1], whole[:, ::-1]]
    for values in views + copies:
        raw = as_raw(values)
        assert raw.shape == (len(values),)
        assert [piece.tobytes() for piece in raw] == [slot.tobytes() for slot in values]
    assert [np.shares_memory(as_raw(v), v) for v in views] == [True] * len(views)
    assert as_raw(np.zeros((4, 0))).shape == (4, 0)
    assert as_raw(np.zeros((0, 3))).shape == (0,)


def test_the_table_is_sound() -> None:
    assert len({field.name for field in FIELDS}) == len(FIELDS)
    assert {field.topic for field in FIELDS} == set(TOPIC_MEANINGS)
    for field in FIELDS:
        assert set(field.profiles) <= set(PROFILES)
        assert {n for n in field.shape if isinstance(n, str)} <= set(LETTERS)
        assert field.dtype in ("<f8", "<f4", "<u4", "<u8")
        assert field.unit
        assert field.meaning


def test_smaller_profiles_leave_out_what_can_be_computed() -> None:
    names = {
        profile: {f.name for topic in TOPICS.values() for f in topic.fields_in(profile)}
        for profile in PROFILES
    }
    sums = {field.name for field in TOPICS["/delay"].fields if field.profiles == ("decisions",)}
    assert names["full"] | sums == {field.name for field in FIELDS}
    assert names["decisions"] == {"prb_owner", "multiplier", "reward_urllc", "reward_embb"} | sums
    assert names["decisions"] - sums < names["compact"] < names["full"]
    assert names["robots"] < {field.name for field in TOPICS["/robots"].fields}
    assert "/world" not in topics_in("compact")


def test_only_models_that_add_something_have_a_topic() -> None:
    for profile in PROFILES:
        wanted = {"/models"} if profile in ("full", "compact") else set()
        assert set(topics_in(profile, 1)) - set(topics_in(profile)) == wanted


@pytest.mark.parametrize(
    ("sizes", "name"),
    [((-1, 2, 3), "num_urllc"), ((1, -2, 3), "num_embb"), ((1, 2, 0), "num_prb"), ((0, 0, 3), "1")],
)
def test_dimensions_are_checked(sizes: tuple[int, int, int], name: str) -> None:
    with pytest.raises(ValueError, match=name):
        LogDims(num_urllc=sizes[0], num_embb=sizes[1], num_prb=sizes[2])
