"""Scenarios that extend others: what is inherited, in which order, and where faults are."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from hiersched.cli import main
from hiersched.experiments.feasible import load_study
from hiersched.scenario import ScenarioError, load_scenario, scenario_to_yaml


@pytest.fixture
def write(tmp_path):
    """Write a scenario; returns its path."""

    def write_file(name, text):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n", encoding="utf-8")
        return path

    return write_file


def fault(path):
    with pytest.raises(ScenarioError) as caught:
        load_study(path)
    return str(caught.value)


def test_a_shipped_scenario_is_extended_by_its_name(write):
    smoke = load_scenario("smoke")
    path = write("mine.yaml", "extends: smoke\nradio: {num_prb: 12}\nlearning: {seeds: [7]}")
    assert load_scenario(path) == replace(
        smoke,
        name="mine",
        radio=replace(smoke.radio, num_prb=12),
        learning=replace(smoke.learning, seeds=(7,)),
        learners={name: replace(learner, seeds=(7,)) for name, learner in smoke.learners.items()},
    )
    assert load_scenario(write("same.yaml", "extends: smoke")) == replace(smoke, name="same")


def test_a_file_is_extended_by_its_path_beside_the_own(write, tmp_path, monkeypatch):
    """Whatever the working directory is; one there comes second, and so do shipped ones."""
    write("base.yaml", "users: {num_embb: 3}")
    path = write("mine.yaml", "extends: base.yaml")
    other = write("sub/other.yaml", "extends: ../base.yaml")
    write("smoke", "users: {num_embb: 5}")
    smoke = write("mine2.yaml", "extends: smoke")
    write("elsewhere/base.yaml", "users: {num_embb: 7}")
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert load_scenario(path).users.num_embb == 3
    assert load_scenario(other).users.num_embb == 3
    assert load_scenario(smoke).users.num_embb == 5
    absolute = write("sub/absolute.yaml", f"extends: {tmp_path / 'base.yaml'}")
    assert load_scenario(absolute).users.num_embb == 3
    from_here = write("sub/here.yaml", "extends: base.yaml")
    assert load_scenario(from_here).users.num_embb == 7


def test_the_nearest_of_a_chain_decides(write):
    write("first.yaml", "users: {num_urllc: 2, num_embb: 2}\ntraffic: {urllc_offered_mbps: 9.0}")
    write("second.yaml", "extends: first.yaml\nusers: {num_embb: 3}\nradio: {num_prb: 9}")
    scenario = load_scenario(write("third.yaml", "extends: second.yaml\nradio: {num_prb: 8}"))
    assert (scenario.users.num_urllc, scenario.users.num_embb, scenario.radio.num_prb) == (2, 3, 8)
    assert scenario.traffic.urllc_offered_mbps == 9.0


def test_a_name_is_not_inherited(write):
    """Two studies in one folder of results would overwrite each other."""
    write("base.yaml", "name: called\n")
    assert load_scenario(write("mine.yaml", "extends: base.yaml")).name == "mine"
    own = write("other.yaml", "extends: base.yaml\nname: own")
    assert load_scenario(own).name == "own"


def test_models_axes_and_mappings_are_inherited_as_overlays_do(write):
    write(
        "base.yaml",
        "radio: {path_loss: {model: macro, cell_radius_m: 300.0}}\n"
        "learners: {a2c: {algorithm: a2c}, flat: {network: mlp}}\n"
        "sweeps: {axes: {load: null, packets: {vary: {traffic.packet_bits: [1.0e+4]},"
        " policies: [pf]}, users.num_embb: [2, 4]}}",
    )
    path = write(
        "mine.yaml",
        "extends: base.yaml\n"
        "radio: {path_loss: {shadowing_db: 0.0}}\n"
        "learners: {flat: {discount: 0.5}}\n"
        "sweeps: {axes: {packets: {vary: {traffic.deadline_s: [0.01]}},"
        " users.num_embb: {policies: [pf]}}}",
    )
    scenario = load_scenario(path)
    loss = scenario.radio.path_loss
    assert (loss.cell_radius_m, loss.shadowing_db) == (300.0, 0.0)
    assert list(scenario.learners) == ["a2c", "flat"]
    flat = scenario.learners["flat"]
    assert (flat.network, flat.discount) == ("mlp", 0.5)
    axes = scenario.sweeps.axes
    assert "load" not in axes
    assert (axes["packets"].vary, axes["packets"].policies) == (
        {"traffic.deadline_s": (0.01,)},
        ("pf",),
    )
    assert axes["users.num_embb"].vary == {"users.num_embb": (2, 4)}
    other = write("other.yaml", "extends: base.yaml\nradio: {path_loss: {model: none}}")
    assert load_scenario(other).radio.path_loss.model == "none"


def test_a_resolved_scenario_can_be_extended(write):
    whole = load_scenario(write("base.yaml", "sweeps: {axes: {load: null}}\nusers: {num_embb: 3}"))
    write("resolved.yaml", scenario_to_yaml(whole))
    scenario = load_scenario(write("mine.yaml", "extends: resolved.yaml\nradio: {num_prb: 30}"))
    assert scenario == replace(whole, name="mine", radio=replace(whole.radio, num_prb=30))


# Files that lie beside the extended one.

TRACK = "t,x,y,theta\n0,0,0,0\n50,50,0,0"
PLUGIN = """
from hiersched.study.registry import table

@table("mine", title="Mine.", reads=())
def my_table(study):
    return {}
"""


def test_files_of_the_extended_one_lie_beside_it(write, write_plugin, tmp_path, monkeypatch):
    write("base/base.yaml", "plugins: [extended_tables.py]\nrobot: {reference_file: track.csv}")
    write("base/track.csv", TRACK)
    write_plugin(tmp_path / "base/extended_tables.py", PLUGIN)
    monkeypatch.chdir(tmp_path.parent)
    text = "extends: base/base.yaml\nrobot: {reference: file, reference_repeat: true}"
    path = write("mine.yaml", text)
    scenario = load_scenario(path)
    assert scenario.plugins == ("extended_tables.py",)
    assert scenario.robot.reference_points[1] == (50.0, 50.0, 0.0, 0.0)
    load_study(path)  # its points, too
    # A file that the own scenario names lies beside it.
    write("track.csv", TRACK.replace("50", "60"))
    own = write("own.yaml", f"{text.replace('{', '{reference_file: track.csv, ')}")
    assert load_scenario(own).robot.reference_points[1][0] == 60.0


def test_faulty_files_of_the_extended_one_are_its_faults(write):
    base = write("base/base.yaml", "robot: {reference: file, reference_file: lost.csv}")
    message = fault(write("mine.yaml", "extends: base/base.yaml"))
    lost = base.parent / "lost.csv"
    assert message.startswith(f"{base}: robot.reference_file: {lost}: cannot be read")
    plug = write("plug.yaml", "plugins: [nowhere_at_all.py]")
    path = write("mine2.yaml", "extends: plug.yaml")
    assert fault(path).startswith(f"{plug}: plugins.0 = 'nowhere_at_all.py': ")


# Faults.


@pytest.mark.parametrize(
    ("own", "base", "lines"),
    [
        # The file that holds a value is named, and the nearest one where both do.
        ("", "radio: {num_prb: 0}", ["base.yaml: radio.num_prb = 0: must be greater"]),
        ("radio: {num_prb: -1}", "radio: {num_prb: 0}", ["mine.yaml: radio.num_prb = -1: must"]),
        ("radio: {num_prb: 9}", "radio: {slots: 0}", ["base.yaml: radio.slots = 0: unknown key"]),
        (
            "traffic: {load: -1.0}",
            "radio: {slot_s: 0.0}",
            ["base.yaml: radio.slot_s = 0.0: must be", "mine.yaml: traffic.load = -1.0: must be"],
        ),
        ("", "sweeps: {load: [0.9]}", ["base.yaml: sweeps.load = [0.9]: is sweeps.axes.load.vary"]),
        (
            "",
            "sweeps: {axes: {traffic.load: []}}",
            ["base.yaml: sweeps.axes.traffic.load.vary.traffic.load = []: "],
        ),
        # Values that do not fit each other are a fault of the whole.
        ("users: {num_embb: 15}", "radio: {num_prb: 21}", ["mine.yaml: users.num_urllc + users"]),
        # Files that cannot be read.
        ("", "radio: {num_prb: 3", ["base.yaml: not valid YAML"]),
        ("", "- radio", ["base.yaml: a scenario is a mapping of sections, not list"]),
        ("", "extends: mine.yaml", ["base.yaml: extends = 'mine.yaml': which extends this file"]),
        ("", "extends: base.yaml", ["base.yaml: extends = 'base.yaml': which extends this file"]),
        ("", "extends: gone.yaml", ["base.yaml: extends = 'gone.yaml': gone.yaml: no such file"]),
        ("", "extends: papper", ["base.yaml: extends = 'papper': papper: no such scenario; there"]),
        ("", "extends: 3", ["base.yaml: extends = 3: must be the name or path of one"]),
        ("", "extends: [smoke]", ["base.yaml: extends = ['smoke']: must be the name or path of"]),
        ("", "extends: .", ["base.yaml: extends = '.': .: a folder; a scenario is a YAML file"]),
    ],
)
def test_faults_name_the_file_that_has_them(write, tmp_path, capsys, own, base, lines):
    write("base.yaml", base)
    path = write("mine.yaml", f"extends: base.yaml\n{own}")
    assert main(["scenario", "check", str(path)]) == 2
    found = capsys.readouterr().err.removeprefix("hiersched: ").splitlines()
    assert len(found) >= len(lines)
    for line in lines:
        assert any(text.startswith(f"{tmp_path}/{line}") for text in found), (line, found)


def test_a_longer_circle_is_found(write):
    for name, base in (("a", "b"), ("b", "c"), ("c", "b")):
        write(f"{name}.yaml", f"extends: {base}.yaml")
    message = fault(write("mine.yaml", "extends: a.yaml"))
    assert re.search(r"c\.yaml: extends = 'b\.yaml': which extends this file in turn$", message)
    # The same file under two names is one.
    link = write("d.yaml", "extends: e.yaml")
    (link.parent / "e.yaml").symlink_to(link)
    assert "which extends this file in turn" in fault(link)


def test_what_a_point_cannot_be_is_a_fault_of_the_scenario_that_is_checked(write):
    write("base.yaml", "sweeps: {axes: {users.num_embb: [4, 15]}}")
    path = write("mine.yaml", "extends: base.yaml\nradio: {num_prb: 22}")
    where = "sweeps.axes.users.num_embb.vary: with users.num_embb = 15"
    assert fault(path).startswith(f"{path}: {where}: users.num_urllc + users.num_embb = 25: ")
