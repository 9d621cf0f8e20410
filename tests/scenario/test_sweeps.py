"""Axes of sweeps: forms, defaults, and every fault with file, key, value and what is allowed."""

from __future__ import annotations

import pytest
import yaml

from hiersched.cli import main
from hiersched.experiments.feasible import load_study
from hiersched.experiments.points import experiments
from hiersched.scenario import (
    ScenarioError,
    load_resolved,
    scenario_to_dict,
    scenario_to_yaml,
    with_values,
)

SCALE = "radio.fading.scale"


def axes_of(scenario):
    return {name: dict(axis.vary) for name, axis in scenario.sweeps.axes.items()}


# Forms.


def test_a_list_under_a_key_is_short_for_varying_it(load_text):
    short = load_text("sweeps: {axes: {traffic.packet_bits: [1.0e+4]}}")
    axis = "{vary: {traffic.packet_bits: [1.0e+4]}}"
    long = load_text(f"sweeps: {{axes: {{traffic.packet_bits: {axis}}}}}")
    assert short == long
    assert short.sweeps.axes["traffic.packet_bits"].policies is None


def test_an_axis_replaces_what_the_defaults_vary_and_keeps_its_policies(load_text):
    plain = load_text("")
    text = "sweeps: {axes: {load: {vary: {traffic.packet_bits: [1.0e+4]}}}}"
    assert axes_of(load_text(text)) == {
        **axes_of(plain),
        "load": {"traffic.packet_bits": (1.0e4,)},
    }
    assert load_text(text).sweeps.axes["load"].policies == "all"
    only_policies = load_text("sweeps: {axes: {load: {policies: [pf]}}}")
    assert axes_of(only_policies) == axes_of(plain)
    assert only_policies.sweeps.axes["load"].policies == ("pf",)


def test_null_takes_an_axis_away_for_good(load_text):
    """Also from what is written with every value in place, which says nothing of it."""
    scenario = load_text("sweeps: {axes: {load: null, reference: null}}")
    assert list(scenario.sweeps.axes) == [
        *("rayleigh_scale", "sampling_s", "load_ratio", "service_coefficient_mbps")
    ]
    assert "load" not in experiments(scenario)
    again = load_text(scenario_to_yaml(scenario))
    assert again == scenario
    older = scenario_to_dict(scenario)
    del older["robot"]["window_s"]
    found, added, _ = load_resolved(yaml.safe_dump(older), load_text.path)
    assert (found, added) == (scenario, ("robot.window_s",))


def test_points_take_values_as_they_stand_in_yaml(load_text):
    scenario = load_text("")
    changed = with_values(scenario, {SCALE: 2, "traffic.urllc_offered_mbps": [1.0] * 10}, "here")
    assert changed.radio.fading.scale == 2.0
    assert changed.traffic.urllc_offered_mbps == (1.0,) * 10
    assert scenario.radio.fading.scale == 1.0
    with pytest.raises(ScenarioError, match=r"^here: with radio\.fading\.scale = 'x': .*number"):
        with_values(scenario, {SCALE: "x"}, "here")
    for key in ("radio.fading.scale.x", "", "radio.", ".scale", "nothing"):
        with pytest.raises(ScenarioError, match=r"^here\..*: unknown key; allowed in "):
            with_values(scenario, {key: 1.0}, "here")


# Faults. `AXIS` stands for one axis, called mine.

VARY = "sweeps.axes.mine.vary"
SECTIONS = "must be a key of users, radio, traffic, objective, schedulers, robot, plant, control"
FAULTS = {
    # Wrong keys.
    "{vary: {radio.fading.scal: [1.0]}}": [
        f"{VARY}.radio.fading.scal: unknown key; allowed in radio.fading: model, scale"
    ],
    "{vary: {radio.scale: [1.0]}}": [f"{VARY}.radio.scale: unknown key; allowed in radio: slot_s"],
    "{vary: {radio.slot_s.ms: [1.0]}}": [f"{VARY}.radio.slot_s.ms: unknown", "radio.slot_s: none"],
    "{vary: {policies.mine.slope: [1.0]}}": [f"{VARY}.policies.mine.slope: unknown key; allowed"],
    "{vary: {radios.num_prb: [25]}}": [f"{VARY}.radios.num_prb: {SECTIONS}"],
    "{vary: {num_prb: [25]}}": [f"{VARY}.num_prb: {SECTIONS}"],
    "{vary: {3: [1.0]}}": ["the key 3 is no text: write it in quotes"],
    # Keys that no slot loop reads.
    "{vary: {learning.discount: [0.5]}}": [
        f"{VARY}.learning.discount: {SECTIONS}",
        "what learners differ in stands under `learners`",
    ],
    "{vary: {learning: [{}]}}": [f"{VARY}.learning: {SECTIONS}"],
    "{vary: {learners.a2c.discount: [0.5]}}": [f"{VARY}.learners.a2c.discount: {SECTIONS}"],
    "{vary: {evaluate.seeds: [[1], [2]]}}": [f"{VARY}.evaluate.seeds: {SECTIONS}"],
    "{vary: {log.compression: [none]}}": [f"{VARY}.log.compression: {SECTIONS}"],
    "{vary: {name: [a, b]}}": [f"{VARY}.name: {SECTIONS}"],
    "{vary: {robot.reference_file: [a.csv]}}": [
        f"{VARY}.robot.reference_file: cannot be varied",
        "vary robot.reference",
    ],
    # Wrong values.
    "{vary: {radio.fading.scale: [1.0, -1.0]}}": [
        f"{VARY}: with {SCALE} = -1.0: {SCALE} = -1.0: must be greater than 0"
    ],
    "{vary: {radio.num_prb: [many]}}": [f"{VARY}: with radio.num_prb = 'many': ", "valid integer"],
    "{vary: {robot.reference: [arc, circle]}}": ["robot.reference = 'circle'", "'figure_eight'"],
    "{vary: {radio.path_loss: [none]}}": ["radio.path_loss = 'none'", "must be a mapping"],
    "{vary: {radio.path_loss: [{model: urban}]}}": [
        "radio.path_loss.model = 'urban'",
        "must be one of none, macro",
    ],
    "{vary: {radio.path_loss: [{model: none, shadowing_db: 8.0}]}}": [
        "radio.path_loss.shadowing_db = 8.0: unknown key; allowed: model"
    ],
    "{vary: {control.sampling_s: [0.02, 0.021]}}": ["control.sampling_s = 0.021", "multiple of"],
    "{vary: {users.num_urllc: [4, 16], traffic.urllc_offered_mbps: [9.0]}}": [
        f"{VARY}: with users.num_urllc = 16, traffic.urllc_offered_mbps = 9.0: "
        "users.num_urllc + users.num_embb = 26: at most radio.num_prb = 25"
    ],
    "{vary: {radio.fading.scale: [.nan]}}": [f"{VARY}: with {SCALE} = nan", "finite number"],
    "{vary: {radio.slot_s: [2024-01-01]}}": ["neither number, text, list nor mapping"],
    # Empty lists, and none.
    "{vary: {radio.fading.scale: []}}": [f"{VARY}.{SCALE} = []", "at least 1 item"],
    "{vary: {radio.fading.scale: 1.0}}": [f"{VARY}.{SCALE} = 1.0", "valid array"],
    "{vary: {}}": [f"{VARY} = {{}}", "at least 1 item"],
    "{vary: [1.0]}": [f"{VARY} = [1.0]", "must be"],
    "{policies: all}": [f"{VARY}: missing"],
    "3": ["sweeps.axes.mine = 3", "must be"],
    # Twice.
    "{vary: {traffic.load: [0.9, 0.9]}}": [f"{VARY}.traffic.load = [0.9, 0.9]: every value once"],
    "{vary: {traffic.load: [0.9, 0.9000000000000001]}}": [
        f"{VARY}: a point would be called '0.9': must be another name"
    ],
    f"{{vary: {{traffic.urllc_offered_mbps: [{[11.125] * 10 + [12.125] * 20}]}}}}": [
        "a point would be called",
        "of 120 characters or fewer",
    ],
    # Policies.
    "{vary: {radio.fading.scale: [1.0]}, policies: [best]}": [
        "sweeps.axes.mine.policies = ['best']: best is no policy; allowed: ddpg, pf, "
    ],
    "{vary: {radio.fading.scale: [1.0]}, policies: [pf, pf]}": [
        "sweeps.axes.mine.policies = ['pf', 'pf']: every policy once"
    ],
    "{vary: {radio.fading.scale: [1.0]}, policies: []}": [
        "sweeps.axes.mine.policies = []",
        "at least 1 item",
    ],
    "{vary: {radio.fading.scale: [1.0]}, policies: some}": [
        "sweeps.axes.mine.policies = 'some'",
        "'all' or 'own'",
    ],
    "{vary: {radio.fading.scale: [1.0]}, polices: all}": [
        "sweeps.axes.mine.polices = 'all': unknown key; allowed: vary, policies"
    ],
}


@pytest.mark.parametrize("axis", FAULTS)
def test_a_faulty_axis_is_named_by_check(axis, load_text, capsys):
    """On lines that begin with the file."""
    load_text.path.write_text(f"sweeps: {{axes: {{mine: {axis}}}}}\n", encoding="utf-8")
    assert main(["scenario", "check", str(load_text.path)]) == 2
    output = capsys.readouterr()
    assert output.out == ""
    lines = output.err.removeprefix("hiersched: ").splitlines()
    assert [line for line in lines if not line.startswith(f"{load_text.path}: ")] == []
    assert [part for part in FAULTS[axis] if part not in output.err] == []


@pytest.mark.parametrize(
    "name", ["evaluate", "generalise", "gain_study", "gain_grid", "gain_noise", "cell", "measure"]
)
def test_an_axis_is_not_called_as_another_part_of_the_study(load_text, name):
    with pytest.raises(ScenarioError) as caught:
        load_text(f"sweeps: {{axes: {{{name}: {{vary: {{{SCALE}: [1.0]}}}}}}}}")
    assert f"sweeps.axes.{name}: must be another name than evaluate, " in str(caught.value)


@pytest.mark.parametrize("name", ["Mine", "my axis", "1st", "my/axis", "''"])
def test_an_axis_has_the_name_of_a_folder(load_text, name):
    with pytest.raises(ScenarioError, match=r"sweeps\.axes\..*String should match pattern"):
        load_text(f"sweeps: {{axes: {{{name}: {{vary: {{{SCALE}: [1.0]}}}}}}}}")


@pytest.mark.parametrize("name", ["classical", "gains"])
def test_a_learner_is_not_called_as_a_group_of_jobs(load_text, name):
    with pytest.raises(ScenarioError, match=f"learners.{name}: the name of jobs of the study"):
        load_text(f"learners: {{{name}: {{algorithm: a2c}}}}")


def test_faults_of_all_axes_are_listed_with_the_file(load_text):
    """One line for a key that there is not, one a point for values."""
    axes = "radio.fading.scal: [1.0, 2.0, 3.0], radio.fading.scale: [-1.0, 1.0, -2.0]"
    load_text(f"sweeps: {{axes: {{{axes}}}}}")
    with pytest.raises(ScenarioError) as caught:
        load_study(load_text.path)
    begin = f"{load_text.path}: sweeps.axes."
    assert [line.partition(" with ")[0] for line in str(caught.value).splitlines()] == [
        f"{begin}radio.fading.scal.vary.radio.fading.scal: unknown key; allowed in radio.fading: "
        "model, scale; did you mean scale?",
        *[f"{begin}radio.fading.scale.vary:"] * 2,
    ]


# Keys of before.


@pytest.mark.parametrize(
    ("key", "new"),
    [
        ("rayleigh_scale", "{radio.fading.scale: [...]}"),
        ("sampling_s", "{control.sampling_s: [...]}"),
        ("reference", "{robot.reference: [...]}"),
        ("load", "{traffic.load: [...]}"),
        ("load_ratio", "{traffic.load_ratio: [...]}"),
        ("service_coefficient_mbps", "{traffic.service_coefficient_mbps: [...]}"),
    ],
)
def test_a_key_of_before_names_the_new_one(load_text, key, new):
    with pytest.raises(ScenarioError) as caught:
        load_text(f"sweeps: {{{key}: [1.0]}}")
    where = f"{load_text.path}: sweeps.{key} = [1.0]: is sweeps.axes.{key}.vary now: "
    assert str(caught.value) == where + new
