"""Fields of every slot from logs of any profile, and the beginning of a run in full."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hiersched.runs.evaluate import evaluate
from hiersched.runs.policies import untrained_policies

from hiersched.log import TOPICS, LogError, LogReader, LogWriter
from hiersched.runs import paths
from hiersched.experiments.logged import load_run, read_slots
from hiersched.scenario import Scenario

ALL = [field.name for topic in TOPICS.values() for field in topic.fields_in("full")]


def evaluated(tiny: Scenario, results: Path, profile: str, **changes: object) -> Scenario:
    scenario = replace(
        tiny,
        log=replace(tiny.log, evaluate_profile=profile),
        evaluate=replace(tiny.evaluate, policies=("edf",), seeds=(11, 12), **changes),
        traffic=replace(tiny.traffic, load=1.2),
    )
    evaluate(scenario, results, "classical", untrained_policies)
    return scenario


@pytest.mark.parametrize("profile", ["compact", "decisions"])
def test_small_logs_have_all_that_full_ones_have(
    tiny: Scenario, results: Path, profile: str
) -> None:
    path = results / paths.evaluation_log("edf", 12)
    evaluated(tiny, results, "full")
    full = read_slots(path, ALL)
    evaluated(tiny, results, profile)
    with LogReader(path) as log:
        assert log.profile == profile
    small = read_slots(path, ALL)
    assert small.fields["late_packets"].any()
    for name in ALL:
        np.testing.assert_array_equal(small.fields[name], full.fields[name], err_msg=name)
        assert small.fields[name].dtype == full.fields[name].dtype, name


def test_the_warm_up_is_noted(tiny: Scenario, results: Path) -> None:
    evaluated(tiny, results, "decisions", warmup_s=0.05, duration_s=0.15)
    run = read_slots(results / paths.evaluation_log("edf", 11), ["rate_mbps"])
    assert (len(run.fields["rate_mbps"]), run.warmup_slots) == (20, 5)
    np.testing.assert_array_equal(run.measured("rate_mbps"), run.fields["rate_mbps"][5:])


def test_the_beginning_of_the_first_worlds_is_there_in_full(tiny: Scenario, results: Path) -> None:
    scenario = evaluated(tiny, results, "decisions", full_logs=1, full_log_s=0.08)
    ((seed, name),) = paths.full_logs(scenario, "edf")
    assert seed == 11
    with LogReader(results / name) as log:
        assert (log.profile, log.num_slots) == ("full", 8)
    whole = read_slots(results / paths.evaluation_log("edf", 11), ALL)
    beginning = read_slots(results / name, ALL)
    for field in ALL:
        np.testing.assert_array_equal(beginning.fields[field], whole.fields[field][:8])
    assert load_run(results / name).num_slots == 8
    names = paths.evaluation_outputs(scenario, "classical")
    written = {str(path.relative_to(results)) for path in (results / "eval").rglob("*.mcap")}
    assert written == set(names)


def test_a_log_that_does_not_follow_from_its_decisions_is_refused(
    tiny: Scenario, results: Path, tmp_path: Path
) -> None:
    evaluated(tiny, results, "decisions")
    path = results / paths.evaluation_log("edf", 11)
    with LogReader(path) as log:
        fields = {}
        for topic in log.topics:
            fields |= log.read(topic)
        fields.pop("slot")
        fields = {name: values.copy() for name, values in fields.items()}
        fields["late_urllc_packets"][7] += 1
        metadata = {key: text for key, text in log.metadata.items() if key != "profile"}
        files = {name: data for name, data in log.attachments.items() if name != "hiersched.proto"}
        other = tmp_path / "other.mcap"
        with LogWriter(other, log.dims, "decisions", metadata, files, slot_ns=log.slot_ns) as new:
            new.write_block(0, fields)
    with pytest.raises(LogError, match="late_urllc_packets does not follow from its decisions"):
        read_slots(other, ["rate_mbps"])


def test_unknown_fields_are_named(results: Path) -> None:
    with pytest.raises(ValueError, match="speed: no field of a log"):
        read_slots(results / "nothing.mcap", ["speed"])
