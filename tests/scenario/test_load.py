from __future__ import annotations

from dataclasses import FrozenInstanceError, fields, is_dataclass, replace
from typing import get_type_hints

import pytest
import yaml

from hiersched.models.model import SECTIONS
from hiersched.scenario import (
    Scenario,
    ScenarioError,
    delay_steps,
    load_resolved,
    load_scenario,
    parameter_notes,
    scenario_sha256,
    scenario_to_dict,
    scenario_to_yaml,
)
from hiersched.scenario.schema import model_at


@pytest.fixture(params=["paper", "smoke"])
def scenario(request, config):
    return load_scenario(
        config / "scenarios" / f"{request.param}.yaml", defaults=config / "defaults.yaml"
    )


def test_every_scenario_of_the_project_is_valid(config):
    files = sorted((config / "scenarios").glob("*.yaml"))
    assert files
    for path in files:
        assert load_scenario(path, defaults=config / "defaults.yaml").name == path.stem


def test_resolved_scenario_reads_back_the_same(scenario, load_text):
    again = load_text(scenario_to_yaml(scenario))
    assert again == scenario
    assert scenario_sha256(again) == scenario_sha256(scenario)
    assert scenario_to_yaml(again) == scenario_to_yaml(scenario)
    assert yaml.safe_load(scenario_to_yaml(scenario)) == scenario_to_dict(scenario)


def test_a_resolved_scenario_of_an_older_version_takes_todays_defaults(
    scenario, config, monkeypatch
):
    """Its hash is that of what is written, and the keys that it lacks are named."""
    monkeypatch.chdir(config.parent)
    written = scenario_to_dict(scenario)
    whole = load_resolved(yaml.safe_dump(written), config / "x.yaml")
    assert whole == (scenario, (), scenario_sha256(scenario))
    del written["robot"]["window_s"], written["radio"]["num_prb"]
    older, added, sha256 = load_resolved(yaml.safe_dump(written), config / "x.yaml")
    assert set(added) == {"robot.window_s", "radio.num_prb"}
    assert sha256 != scenario_sha256(scenario)
    defaults = yaml.safe_load((config / "defaults.yaml").read_text(encoding="utf-8"))
    assert older.radio.num_prb == defaults["radio"]["num_prb"]


def test_a_resolved_scenario_with_a_fault_names_where_it_is_from(scenario, config):
    written = scenario_to_dict(scenario)
    written["radio"]["num_prb"] = -3
    with pytest.raises(ScenarioError, match=r"run\.mcap.*radio\.num_prb = -3"):
        load_resolved(yaml.safe_dump(written), config / "run.mcap")


def test_overlay_replaces_what_it_names_and_nothing_else(load_text, config):
    plain = load_text("name: plain\n")
    changed = load_text("name: plain\nradio: {fading: {scale: 2.0}}\nlearning: {hidden: [8]}\n")
    assert changed == replace(
        plain,
        radio=replace(plain.radio, fading=replace(plain.radio.fading, scale=2.0)),
        learning=replace(plain.learning, hidden=(8,)),
    )
    defaults = yaml.safe_load((config / "defaults.yaml").read_text(encoding="utf-8"))
    defaults["control"]["hold_samples"] = 5  # null: as long as gain schedules are held
    for axis in defaults["sweeps"]["axes"].values():
        axis.setdefault("policies", None)  # those of `sweeps.policies`
    assert scenario_to_dict(plain) == {"name": "plain", **defaults}


def test_a_predictor_is_not_held_and_gain_schedules_are(load_text):
    control = load_text("control: {method: predictor}\n").control
    assert control.hold_samples == 0
    assert load_text("control: {method: h2}\n").control.hold_samples == 5
    assert load_text("control: {hold_samples: 2}\n").control.hold_samples == 2
    assert load_text("control: {hold_samples: 0}\n").control.hold_samples == 0


def test_scenarios_that_differ_in_a_value_have_other_hashes(load_text):
    plain = load_text("name: plain\n")
    changed = load_text("name: plain\nradio: {fading: {scale: 2.0}}\n")
    assert scenario_sha256(changed) != scenario_sha256(plain)


def test_a_scenario_is_named_after_its_file(load_text):
    assert load_text("").name == "case"
    assert load_text("radio: {num_prb: 30}").radio.num_prb == 30


def test_whole_numbers_do_for_floats_but_not_the_other_way_round(load_text):
    assert load_text("traffic: {load: 1}").traffic.load == 1.0
    with pytest.raises(ScenarioError, match=r"radio\.num_prb = 25\.5"):
        load_text("radio: {num_prb: 25.5}")


def test_a_learner_is_the_section_learning_but_for_what_it_names(load_text):
    """Read back, too: the resolved scenario holds every key of every learner."""
    text = "learning: {discount: 0.5}\nlearners: {flat: {network: mlp}, same: }\n"
    scenario = load_text(text)
    assert scenario.learners["flat"] == replace(scenario.learning, network="mlp")
    assert scenario.learners["same"] == scenario.learning
    assert list(scenario.learned) == ["ddpg", "flat", "same"]
    assert load_text(scenario_to_yaml(scenario)) == scenario


def test_table_one_of_the_paper(config):
    paper = load_scenario(config / "scenarios" / "paper.yaml", defaults=config / "defaults.yaml")
    assert paper.radio.bandwidth_hz == 10e6
    assert paper.radio.num_prb == 25
    assert (paper.radio.tx_power_dbm, paper.radio.noise_dbm) == (20.0, -110.0)
    assert (paper.traffic.deadline_s, paper.traffic.reliability) == (0.02, 0.95)
    assert paper.traffic.arrivals.rate_sensitivity == 0.1


def test_scenarios_are_frozen(scenario):
    with pytest.raises(FrozenInstanceError):
        scenario.radio.num_prb = 3
    with pytest.raises(FrozenInstanceError):
        scenario.name = "other"
    assert isinstance(hash(scenario), int)


def test_defaults_explain_every_key_of_the_schema(config, load_text):
    keys = {
        f"{section}.{field.name}"
        for section, kind in get_type_hints(Scenario).items()
        if is_dataclass(kind)
        for field in fields(kind)
    }
    keys |= {"plugins", "policies", "learners", "robot_kinds"}
    defaults = load_text("")
    for section in SECTIONS:
        keys -= {section}
        keys |= {f"{section}.{field.name}" for field in fields(model_at(defaults, section))}
    notes = parameter_notes(config / "defaults.yaml")
    keys -= {"sweeps.axes"}
    keys |= {f"sweeps.axes.{name}.vary" for name in defaults.sweeps.axes}
    keys |= {f"sweeps.axes.{n}.policies" for n, a in defaults.sweeps.axes.items() if a.policies}
    assert {note.key for note in notes} == keys
    assert len(notes) == len(keys)
    assert {note.origin for note in notes} == {"paper", "assumed"}
    assert [note.key for note in notes if not note.unit] == []


def test_a_key_without_its_note_is_refused(tmp_path):
    path = tmp_path / "defaults.yaml"
    path.write_text("radio:\n  num_prb: 25  # how many\n", encoding="utf-8")
    with pytest.raises(ScenarioError, match=r"line 2: num_prb lacks its comment"):
        parameter_notes(path)


@pytest.mark.parametrize(
    ("delay_s", "steps"),
    [(0.0, 0), (0.001, 1), (0.02, 1), (0.0201, 2), (0.06, 3), (0.24, 12), (0.1 + 0.2, 15)],
)
def test_delay_in_samples_is_rounded_up(delay_s, steps):
    assert delay_steps(delay_s, 0.02) == steps
