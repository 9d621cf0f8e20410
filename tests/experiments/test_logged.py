"""Fields of every slot from logs of any profile, and the beginning of a run in full."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hiersched.experiments import files
from hiersched.experiments.logged import load_run, read_slots
from hiersched.experiments.points import experiments
from hiersched.log import TOPICS, LogError, LogReader, LogWriter
from hiersched.scenario import Scenario

Evaluate = Callable[..., Scenario]
ALL = [field.name for topic in TOPICS.values() for field in topic.fields_in("full")]


@pytest.fixture
def evaluated(tiny: Scenario, run: Callable[..., None]) -> Callable[..., Scenario]:
    """Evaluate EDF in two worlds, with logs of a profile."""

    def evaluate(profile: str, **changes: object) -> Scenario:
        scenario = replace(
            tiny,
            log=replace(tiny.log, evaluate_profile=profile),
            evaluate=replace(tiny.evaluate, policies=("edf",), seeds=(11, 12), **changes),
            traffic=replace(tiny.traffic, load=1.2),
        )
        run(scenario, "evaluate")
        return scenario

    return evaluate


@pytest.mark.parametrize("profile", ["compact", "decisions"])
def test_small_logs_have_all_that_full_ones_have(
    results: Path, evaluated: Evaluate, profile: str
) -> None:
    path = results / "runs/evaluate/edf/seed12.mcap"
    evaluated("full")
    full = read_slots(path, ALL)
    evaluated(profile)
    with LogReader(path) as log:
        assert log.profile == profile
    small = read_slots(path, ALL)
    assert small.fields["late_packets"].any()
    for name in ALL:
        np.testing.assert_array_equal(small.fields[name], full.fields[name], err_msg=name)
        assert small.fields[name].dtype == full.fields[name].dtype, name


def test_the_warm_up_is_noted(results: Path, evaluated: Evaluate) -> None:
    evaluated("decisions", warmup_s=0.05, duration_s=0.15)
    run = read_slots(results / "runs/evaluate/edf/seed11.mcap", ["rate_mbps"])
    assert (len(run.fields["rate_mbps"]), run.warmup_slots) == (20, 5)
    np.testing.assert_array_equal(run.measured("rate_mbps"), run.fields["rate_mbps"][5:])


def test_the_beginning_of_the_first_worlds_is_there_in_full(
    results: Path, evaluated: Evaluate
) -> None:
    scenario = evaluated("decisions", full_logs=1, full_log_s=0.08)
    name = "runs/evaluate/edf/seed11_full.mcap"
    with LogReader(results / name) as log:
        assert (log.profile, log.num_slots) == ("full", 8)
    whole = read_slots(results / "runs/evaluate/edf/seed11.mcap", ALL)
    beginning = read_slots(results / name, ALL)
    for field in ALL:
        np.testing.assert_array_equal(beginning.fields[field], whole.fields[field][:8])
    assert load_run(results / name).num_slots == 8
    names = files.group_files(scenario, experiments(scenario)["evaluate"], "classical")
    written = {str(path.relative_to(results)) for path in (results / "runs").rglob("*.mcap")}
    assert written == set(names)


def test_a_log_that_does_not_follow_from_its_decisions_is_refused(
    results: Path, evaluated: Evaluate, tmp_path: Path
) -> None:
    evaluated("decisions")
    path = results / "runs/evaluate/edf/seed11.mcap"
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
