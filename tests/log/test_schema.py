from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from grpc_tools import protoc

import hiersched.log
from hiersched.log import TOPICS, LogDims
from hiersched.log.layout import as_raw
from hiersched.log.schema import (
    EVENTS_SCHEMA,
    EVENTS_TOPIC,
    PROFILES,
    SCHEMA_VERSION,
    channel_ids,
    describes,
    descriptor_set,
    proto_source,
    topics_in,
)
from hiersched.simulator.record import SlotLayout

FOLDER = Path(hiersched.log.__file__).parent
NUMPY_TYPES = {
    FieldDescriptorProto.TYPE_DOUBLE: "<f8",
    FieldDescriptorProto.TYPE_FLOAT: "<f4",
    FieldDescriptorProto.TYPE_FIXED32: "<u4",
    FieldDescriptorProto.TYPE_FIXED64: "<u8",
}


@pytest.mark.parametrize(
    ("source", "message"),
    [("hiersched.proto", "hiersched.Channel"), ("foxglove/Log.proto", EVENTS_SCHEMA)],
)
def test_compiled_schema_is_what_protoc_makes_of_the_source(
    source: str, message: str, tmp_path: Path
) -> None:
    out = tmp_path / "set.binpb"
    wellknown = Path(protoc.__file__).parent / "_proto"
    arguments = ["", f"-I{FOLDER}", f"-I{wellknown}", "--include_imports"]
    assert protoc.main([*arguments, f"--descriptor_set_out={out}", source]) == 0
    fresh = FileDescriptorSet.FromString(out.read_bytes())
    assert fresh == FileDescriptorSet.FromString(descriptor_set(message))


def test_topics_table_is_the_protobuf_schema() -> None:
    (file,) = FileDescriptorSet.FromString(descriptor_set("hiersched.Channel")).file
    compiled = {
        f"{file.package}.{message.name}": [
            (f.name, f.number, NUMPY_TYPES[f.type], f.label == f.LABEL_REPEATED)
            for f in message.field
        ]
        for message in file.message_type
    }
    table = {
        topic.message: [(f.name, f.number, f.dtype, f.shape != ()) for f in topic.fields]
        for topic in TOPICS.values()
    }
    assert table == compiled


def test_topics_table_is_the_record_of_the_simulator() -> None:
    """`write_block` takes what the simulator hands out, without a conversion."""
    dims = LogDims(num_urllc=3, num_embb=2, num_prb=7, num_model_values=8)
    layout = SlotLayout(num_users=5, num_robots=3, num_prb=7, num_model_values=8)
    record = layout.record(1, 2).environment(0)
    table = {
        field.name: (np.dtype(field.dtype), (2, *field.concrete_shape(dims)))
        for topic in topics_in("full", 8).values()
        for field in topic.fields[1:]
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


def test_field_names_are_unique_over_all_topics() -> None:
    names = [field.name for topic in TOPICS.values() for field in topic.fields[1:]]
    assert len(names) == len(set(names))


def test_proto_source_names_the_schema_version() -> None:
    assert re.search(rb"Schema version (\d+)", proto_source())[1] == str(SCHEMA_VERSION).encode()


def test_compact_profile_leaves_out_what_seed_and_scenario_give_again() -> None:
    assert set(channel_ids("full", 8)) == {*TOPICS, EVENTS_TOPIC} - {"/slices"}
    assert set(channel_ids("full", 8)) - set(channel_ids("compact", 8)) == {"/world"}
    left_out = {
        field.name
        for topic in topics_in("full").values()
        for field in set(topic.fields) - set(topic.fields_in("compact"))
    }
    assert left_out == {
        *("slot", "fading_power", "arrival_uniform", "robot_normal", "average_rate_mbps"),
        *("hol_delay_s", "delay_s", "constraint", "network_delay_s", "gain_delay_steps"),
        *("state", "reference", "control"),
    }


def test_only_models_that_add_something_have_a_topic() -> None:
    for profile in PROFILES:
        without, added = channel_ids(profile), channel_ids(profile, 1)
        wanted = {"/models"} if profile in ("full", "compact") else set()
        assert set(added) - set(without) == wanted
        assert list(added)[-1] == EVENTS_TOPIC


def test_decisions_profile_has_decisions_and_means_of_slices() -> None:
    contained = {
        name: [field.name for field in topic.fields_in("decisions")[1:]]
        for name, topic in topics_in("decisions").items()
    }
    assert contained == {
        "/allocation": ["prb_owner"],
        "/delay": ["multiplier", "reward_urllc", "reward_embb"],
        "/slices": [field.name for field in TOPICS["/slices"].fields[1:]],
    }
    with pytest.raises(ValueError, match="profile is 'sums'; allowed: full, compact, decisions"):
        TOPICS["/slices"].fields_in("sums")


def test_a_message_is_described_whatever_else_is() -> None:
    """Files of older versions name fewer topics in their schemas."""
    ours = FileDescriptorSet.FromString(descriptor_set("hiersched.Delay"))
    messages = ours.file[0].message_type
    assert [messages.pop().name for _ in range(2)] == ["Models", "Slices"]
    older = ours.SerializeToString()
    assert describes(older, "hiersched.Delay")
    assert not describes(older, "hiersched.Slices")
    next(m for m in messages if m.name == "Delay").field[3].name = "due"
    assert not describes(ours.SerializeToString(), "hiersched.Delay")
    assert describes(ours.SerializeToString(), "hiersched.Queue")
    assert not describes(older[:-1], "hiersched.Delay")
    assert not describes(b"", EVENTS_SCHEMA)


@pytest.mark.parametrize(
    ("sizes", "name"),
    [((-1, 2, 3), "num_urllc"), ((1, -2, 3), "num_embb"), ((1, 2, 0), "num_prb"), ((0, 0, 3), "1")],
)
def test_dimensions_are_checked(sizes: tuple[int, int, int], name: str) -> None:
    with pytest.raises(ValueError, match=name):
        LogDims(num_urllc=sizes[0], num_embb=sizes[1], num_prb=sizes[2])
