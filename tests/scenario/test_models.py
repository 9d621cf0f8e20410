"""Models by name: built-in ones, those of plug-ins, their faults; old keys; policies; learners."""

from __future__ import annotations

import importlib.metadata
import sys
from pathlib import Path
from types import ModuleType

import pytest
import yaml

from hiersched.core import registry
from hiersched.core.extras import EXTRA_OF
from hiersched.core.registry import ALGORITHMS, PluginError, load_plugin
from hiersched.experiments import dependencies
from hiersched.experiments.points import experiments
from hiersched.models.model import PATH_LOSS, SECTIONS
from hiersched.policies.find import ImportedPolicy
from hiersched.policies.registry import RULES
from hiersched.scenario import (
    ScenarioError,
    load_resolved,
    load_scenario,
    parameter_notes,
    scenario_notes,
    scenario_sha256,
    scenario_to_dict,
    scenario_to_yaml,
)
from hiersched.scenario.old_keys import OLD_KEYS, converted
from hiersched.scenario.schema import model_at

HEAD = """
from __future__ import annotations
from dataclasses import dataclass
from typing import Annotated, Literal
import numpy as np
from hiersched.core.parameters import Count, Note, Positive
from hiersched.core.registry import ALGORITHMS
from hiersched.models.model import ARRIVALS, FADING, PATH_LOSS, Arrivals, Model, PathLoss
from hiersched.policies.registry import RULES, Rule
"""
POWER_LAW = """
@PATH_LOSS.model
@dataclass(frozen=True, kw_only=True)
class PowerLaw(PathLoss):
    model: Literal["power_law"]
    exponent: Annotated[Positive, Note("1", "assumed", "of the distance")]
    steps: Count = 3
    heights_m: tuple[float, ...] = (10.0, 1.5)

    def gain(self, key, num_users):
        return np.full(num_users, 10.0 ** -self.exponent)

    def least_gain_db(self):
        return -10.0 * self.exponent

    def faults(self, scenario):
        if self.steps <= scenario.num_users:
            return []
        return [f"radio.path_loss.steps = {self.steps}: at most {scenario.num_users} users"]
"""
WANTED = "plugins: [{name}.py]\nradio: {{path_loss: {{model: power_law, exponent: {exponent}}}}}\n"


@pytest.fixture
def plugin(tmp_path, request, write_plugin):
    """Write a plug-in whose name is the test's own beside the scenario's file; returns its path."""

    def write(text, name="mine", folder=tmp_path):
        own = "".join(c if c.isalnum() else "_" for c in request.node.name.lower())[:80]
        return write_plugin(folder / f"{name}_{own}.py", HEAD + text)

    return write


def fails(load, text):
    with pytest.raises(ScenarioError) as caught:
        load(text)
    return str(caught.value)


def wanted(path, exponent="3.5", more=""):
    return WANTED.format(name=path.stem, exponent=exponent) + more


# Built-in models.


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        (
            "radio: {path_loss: {model: mcro}}",
            ["radio.path_loss.model = 'mcro': must be one of none, macro; did you mean macro? ("],
        ),
        ("radio: {path_loss: {model: 3}}", ["radio.path_loss.model = 3: must be one of"]),
        (
            "radio: {path_loss: macro}",
            [
                "radio.path_loss = 'macro': must be a mapping with the key `model`, such as "
                "{model: macro}"
            ],
        ),
        ("plant: 3", ["plant = 3: must be a mapping", "such as {model: unicycle}"]),
        ("plant: {model: linear}", ["plant.A: missing", "plant.B: missing", "plant.R: missing"]),
        (
            "radio: {fading: {model: rayleigh, k_db: 3}}",
            ["radio.fading.k_db = 3: unknown key; allowed: model, scale"],
        ),
        (
            "radio: {path_loss: {model: macro, cell_radius_m: -1.0}}",
            ["radio.path_loss.cell_radius_m = -1.0: must be greater than 0"],
        ),
        (
            "radio: {path_loss: {model: macro, cell_radius_m: far}}",
            ["radio.path_loss.cell_radius_m = 'far': must be a valid number"],
        ),
        (
            "traffic: {arrivals: {batch_packets: 2.5}, queue: {model: lifo}}",
            ["traffic.arrivals.batch_packets = 2.5", "traffic.queue.model = 'lifo': must be one"],
        ),
        (
            "radio: {path_loss: {model: macro, shadowing_db: 1e1}}",
            ["radio.path_loss.shadowing_db = '1e1'", "write 1.0e-3"],
        ),
        (
            "radio: {fading: {scale: .nan}}",
            ["radio.fading.scale", "finite number"],
        ),
    ],
)
def test_faults_of_built_in_models_name_key_and_value(load_text, text, lines):
    message = fails(load_text, text)
    assert message.startswith(f"{load_text.path}: ")
    for line in lines:
        assert line in message


def test_a_section_without_model_is_a_fault_of_the_file_that_lacks_it(tmp_path, config):
    text = (config / "defaults.yaml").read_text(encoding="utf-8")
    defaults, case = tmp_path / "defaults.yaml", tmp_path / "case.yaml"
    kept = [line for line in text.splitlines() if not line.strip().startswith("model: rayleigh")]
    defaults.write_text("\n".join(kept), encoding="utf-8")
    case.write_text("name: case\n", encoding="utf-8")
    with pytest.raises(ScenarioError, match=r"radio\.fading\.model: missing"):
        load_scenario(case, defaults=defaults)


def test_faults_of_several_models_are_listed_together(load_text):
    message = fails(
        load_text,
        "radio: {num_prb: 0, fading: {scale: 0}, path_loss: {model: macro, radius: 3}}\n"
        "traffic: {arrivals: {rate_sensitivity: 2.0}}",
    )
    keys = [line.split(": ")[1].split(" =")[0] for line in message.splitlines()]
    assert set(keys) == {
        "radio.num_prb",
        "radio.fading.scale",
        "radio.path_loss.radius",
        "traffic.arrivals.rate_sensitivity",
    }


def test_another_model_drops_the_defaults_keys_and_takes_its_own(load_text):
    macro = load_text("radio: {path_loss: {model: macro, shadowing_db: 4}}").radio.path_loss
    assert (macro.cell_radius_m, macro.min_distance_m, macro.shadowing_db) == (400.0, 35.0, 4.0)
    resolved = scenario_to_dict(load_text("radio: {path_loss: {model: macro}}"))
    assert resolved["radio"]["path_loss"] == {
        "model": "macro",
        "cell_radius_m": 400.0,
        "min_distance_m": 35.0,
        "shadowing_db": 8.0,
    }
    # The same model, named once more: the default's keys stay.
    same = load_text("radio: {fading: {model: rayleigh}}").radio.fading
    assert same.scale == 1.0


def test_what_the_defaults_say_of_models_is_what_the_classes_say(load_text, config):
    plain = load_text("")
    said = {note.key: note for note in parameter_notes(config / "defaults.yaml")}
    for section in SECTIONS:
        for key, note in model_at(plain, section).notes().items():
            written = said[f"{section}.{key}"]
            assert (written.unit, written.origin, written.meaning) == tuple(vars(note).values())


def test_every_key_of_a_scenario_has_a_note(load_text, config):
    defaults = config / "defaults.yaml"
    assert scenario_notes(load_text(""), defaults) == parameter_notes(defaults)
    macro = load_text("radio: {path_loss: {model: macro}}")
    notes = {note.key: note for note in scenario_notes(macro, defaults)}
    assert notes["radio.path_loss.cell_radius_m"].unit == "m"
    assert notes["radio.path_loss.model"].origin == "paper"
    assert len(notes) == len(parameter_notes(defaults)) + 3


# Plug-ins.


def test_a_plugin_adds_a_path_loss(load_text, plugin):
    path = plugin(POWER_LAW)
    scenario = load_text(wanted(path))
    found = scenario.radio.path_loss
    assert (found.model, found.exponent, found.steps, found.heights_m) == (
        *("power_law", 3.5, 3),
        (10.0, 1.5),
    )
    assert scenario.plugins == (f"{path.stem}.py",)
    assert scenario_to_dict(scenario)["radio"]["path_loss"] == {
        "model": "power_law",
        "exponent": 3.5,
        "steps": 3,
        "heights_m": [10.0, 1.5],
    }
    assert load_text(scenario_to_yaml(scenario)) == scenario
    assert isinstance(hash(scenario), int)


def test_a_plugin_is_found_beside_the_scenario_or_from_where_one_works(
    plugin, tmp_path, config, monkeypatch
):
    path = plugin(POWER_LAW, folder=tmp_path / "scenarios")
    case = tmp_path / "scenarios" / "case.yaml"
    case.write_text(wanted(path), encoding="utf-8")
    scenario = load_scenario(case, defaults=config / "defaults.yaml")
    # As from a log: the text comes from anywhere, the plug-in from the working directory.
    monkeypatch.chdir(path.parent)
    again, added, sha256 = load_resolved(scenario_to_yaml(scenario), Path("x/scenario.yaml"))
    assert (again, added, sha256) == (scenario, (), scenario_sha256(scenario))


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        ("exponent: 3.5, slope: 1", "path_loss.slope = 1: unknown key; allowed: model, exponent,"),
        ("exponent: 0", "radio.path_loss.exponent = 0: must be greater than 0"),
        ("exponent: steep", "radio.path_loss.exponent = 'steep': must be a valid number"),
        ("steps: 2", "radio.path_loss.exponent: missing"),
        ("exponent: 3.5, heights_m: [1.0, low]", "path_loss.heights_m.1 = 'low'"),
        ("exponent: 3.5, steps: 21", "radio.path_loss.steps = 21: at most 20 users"),
        ("exponent: 30.0", "the signal-to-noise ratio goes from -170 dB"),
    ],
)
def test_faults_of_a_plugins_model(load_text, plugin, keys, line):
    path = plugin(POWER_LAW)
    text = f"plugins: [{path.name}]\nradio: {{path_loss: {{model: power_law, {keys}}}}}\n"
    message = fails(load_text, text)
    assert message.startswith(f"{load_text.path}: ")
    assert line in message


def test_a_check_that_fails_itself_is_a_fault(load_text, plugin):
    path = plugin(POWER_LAW.replace("if self.steps <=", "if 1 / 0 <="))
    message = fails(load_text, wanted(path))
    assert "radio.path_loss: its check of the scenario fails: ZeroDivisionError" in message


def test_without_its_plugin_a_model_is_unknown(load_text):
    message = fails(load_text, "radio: {path_loss: {model: power_law, exponent: 3.5}}")
    assert "radio.path_loss.model = 'power_law': must be one of none, macro" in message
    assert "one of a plug-in needs its file: `plugins: [file.py]`" in message


def test_a_changed_file_is_run_again_and_an_unchanged_one_is_not(load_text, plugin):
    path = plugin(POWER_LAW)
    first = load_text(wanted(path))
    assert load_text(wanted(path)).radio.path_loss == first.radio.path_loss
    assert type(load_text(wanted(path)).radio.path_loss) is type(first.radio.path_loss)
    plugin(POWER_LAW.replace("steps: Count = 3", "steps: Count = 7"))
    assert load_text(wanted(path)).radio.path_loss.steps == 7
    plugin(POWER_LAW.replace('"power_law"', '"law"'))
    message = fails(load_text, wanted(path))
    assert "must be one of none, macro, law" in message


def test_a_file_that_raises_is_named_and_leaves_nothing(load_text, plugin):
    path = plugin(POWER_LAW + "\nraise RuntimeError('not today')\n")
    message = fails(load_text, wanted(path))
    assert f"{load_text.path}: plugins.0 = '{path.name}': " in message
    assert "RuntimeError: not today" in message
    assert "power_law" not in PATH_LOSS
    assert path.stem not in sys.modules
    plugin(POWER_LAW)
    assert load_text(wanted(path)).radio.path_loss.exponent == 3.5
    plugin("this is no Python\n")
    assert "SyntaxError" in fails(load_text, wanted(path))


def test_missing_files_are_all_named(load_text):
    message = fails(load_text, "plugins: [a.py, b.txt]\n")
    lines = message.splitlines()
    assert [line.split(": ")[1] for line in lines] == ["plugins.0 = 'a.py'", "plugins.1 = 'b.txt'"]
    assert "no such Python file" in lines[0]


def test_a_missing_plugin_says_where_it_was_looked_for_and_what_there_is(load_text, plugin):
    """Beside the scenario and where the command runs, never in the package's own folders."""
    path = plugin(POWER_LAW)
    text = f"extends: smoke\nplugins: [{path.stem[:-1]}.py]\n"
    message = fails(load_text, text)
    assert f"no such Python file in {load_text.path.parent.resolve()}" in message
    assert f"; did you mean {path.name}? (hiersched new DIR" in message
    assert "hiersched/config" not in message
    assert "did you mean" not in fails(load_text, "plugins: [qqqqqqqq.py]\n")


@pytest.mark.parametrize(
    ("name", "texts"),
    [
        ("scipyy.linalg", ["No module named 'scipyy'; did you mean scipy?", "pip install PACKAGE"]),
        ("qqqqqqqq", ["No module named 'qqqqqqqq' (", "`plugins: [qqqqqqqq.py]`"]),
        ("stable_baselines3", ["'stable_baselines3': pip install 'hiersched[sb3]'"]),
    ],
)
def test_a_plugin_that_lacks_a_package_says_what_to_install(
    load_text, plugin, monkeypatch, name, texts
):
    if name in EXTRA_OF:
        monkeypatch.delitem(sys.modules, name, raising=False)
        monkeypatch.setattr(sys, "meta_path", [Missing(name), *sys.meta_path])
    path = plugin(f"# one\n# two\nimport {name}\n")
    line = path.read_text(encoding="utf-8").splitlines().index(f"import {name}") + 1
    message = fails(load_text, wanted(path))
    assert f"{path.name}, line {line}: ModuleNotFoundError: " in message
    for text in texts:
        assert text in message


class Missing:
    """Finds that a package is not installed."""

    def __init__(self, name):
        self.name = name

    def find_spec(self, name, path=None, target=None):
        if name == self.name:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


@pytest.mark.parametrize("value", ["mine.py", "[3]", "{mine: py}"])
def test_plugins_are_a_list_of_files(load_text, value):
    assert "plugins" in fails(load_text, f"plugins: {value}\n")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (POWER_LAW.replace('"power_law"', '"macro"'), "radio.path_loss.model 'macro': the name is"),
        (
            POWER_LAW.replace('model: Literal["power_law"]', "model: str"),
            "with a field `model: Lit",
        ),
        (POWER_LAW.replace("(PathLoss)", "(Model)"), "is a frozen dataclass, a PathLoss"),
        (POWER_LAW.replace("frozen=True, ", ""), "is a frozen dataclass"),
        (POWER_LAW.replace("@dataclass(frozen=True, kw_only=True)\n", ""), "is a frozen dataclass"),
    ],
)
def test_what_is_no_model_or_has_a_taken_name_is_refused(load_text, plugin, text, message):
    path = plugin(text)
    assert message in fails(load_text, wanted(path))


def test_two_plugins_may_not_share_a_model_or_a_module_name(load_text, plugin, tmp_path):
    one, other = plugin(POWER_LAW), plugin(POWER_LAW, name="other")
    message = fails(load_text, f"plugins: [{one.name}, {other.name}]\n")
    assert f"plugins.1 = '{other.name}'" in message
    assert f"'power_law': the name is taken by {one.resolve()}:PowerLaw" in message
    twin = plugin(POWER_LAW, folder=tmp_path / "elsewhere")
    with pytest.raises(PluginError, match=r"there is another module .* give the plug-in another"):
        load_plugin(twin)


@pytest.mark.parametrize("name", ["numpy", "this", "hiersched"])
def test_a_plugin_may_not_hide_another_module(tmp_path, name):
    path = tmp_path / f"{name}.py"
    path.write_text("", encoding="utf-8")
    with pytest.raises(PluginError, match=f"there is another module '{name}' already"):
        load_plugin(path)
    assert getattr(sys.modules.get(name), "__file__", "") != str(path)


def test_a_plugin_has_the_name_of_a_module(tmp_path):
    path = tmp_path / "my-models.py"
    path.write_text("", encoding="utf-8")
    with pytest.raises(PluginError, match="'my-models' cannot be the name of a module"):
        load_plugin(path)


def test_a_plugin_imports_its_neighbours(load_text, plugin):
    helper = plugin("EXPONENT = 2.5\n", name="helper")
    path = plugin(f"from {helper.stem} import EXPONENT\n" + POWER_LAW)
    assert load_text(wanted(path)).radio.path_loss.model == "power_law"


class EntryPoint:
    def __init__(self, load):
        self.name, self.value, self.load = "extra", "extra.models", load


@pytest.fixture
def installed(monkeypatch):
    """Have one installed package name a plug-in; the function given loads it."""

    def install(load):
        points = [EntryPoint(load)]
        monkeypatch.setattr(
            registry, "entry_points", lambda group: points if group == "hiersched.models" else []
        )
        registry._installed.cache_clear()

    yield install
    monkeypatch.undo()
    registry._installed.cache_clear()


def test_an_installed_package_adds_models(load_text, plugin, installed):
    path = plugin(POWER_LAW)
    calls = []

    def load() -> ModuleType:
        calls.append(1)
        return load_plugin(path)

    installed(load)
    text = "radio: {path_loss: {model: power_law, exponent: 3.5}}"
    assert load_text(text).radio.path_loss.exponent == 3.5
    assert load_text(text).plugins == ()
    assert calls == [1]
    assert importlib.metadata.entry_points(group="hiersched.models") is not None


def test_an_installed_package_that_raises_is_named(load_text, installed):
    def load():
        raise RuntimeError("broken")

    installed(load)
    message = fails(load_text, "")
    assert message.startswith(f"{load_text.path}: entry point extra = extra.models")
    assert "RuntimeError: broken" in message


def test_sweeps_of_the_rayleigh_scale_need_a_scale(load_text, plugin):
    path = plugin(
        "@FADING.model\n@dataclass(frozen=True)\nclass Flat(Model):\n"
        '    model: Literal["flat"] = "flat"\n'
    )
    text = f"plugins: [{path.name}]\nradio: {{fading: {{model: flat}}}}\n"
    with pytest.raises(ScenarioError, match=r"rayleigh_scale.*radio\.fading\.scale"):
        experiments(load_text(text))
    scenario = load_text(f"{text}sweeps: {{axes: {{rayleigh_scale: null}}}}")
    # The default's key `scale` is gone with its model.
    assert scenario_to_dict(scenario)["radio"]["fading"] == {"model": "flat"}
    assert "rayleigh_scale" not in experiments(scenario)


# What a job depends on.


def values_of(scenario, name, group="classical"):
    return dependencies.run_values(scenario, experiments(scenario)[name], group)


def test_an_edited_plugin_changes_what_uses_it_and_nothing_else(load_text, plugin):
    def jobs():
        scenario = load_text(wanted(path, more="control: {max_delay_s: 0.04}\n"))
        return {
            "evaluate": values_of(scenario, "evaluate"),
            "load": values_of(scenario, "load"),
            "train": dependencies.train_values(scenario, "ddpg"),
            "gain_study": values_of(scenario, "gain_study", "gains"),
            "gains": dependencies.gains_values(scenario, "schedule"),
            "stability": dependencies.stability_values(scenario),
        }

    helper = plugin("EXPONENT = 2.5\n", name="helper")
    path = plugin(f"import {helper.stem}\n" + POWER_LAW)
    before = jobs()
    assert jobs() == before
    plugin("EXPONENT = 2.6\n", name="helper")
    after_helper = jobs()
    plugin(f"import {helper.stem}\n# other\n" + POWER_LAW)
    after = jobs()
    for one, other in ((before, after_helper), (after_helper, after)):
        changed = {name for name in one if one[name] != other[name]}
        assert changed == {"evaluate", "load", "train", "gain_study"}


# Old keys.

OLD = {
    "radio": {
        "path_loss": "macro",
        "cell_radius_m": 300.0,
        "min_distance_m": 20.0,
        "shadowing_db": 6.0,
        "rayleigh_scale": 0.5,
    },
    "traffic": {
        "batch_packets": 2,
        "rate_sensitivity": 0.2,
        "reference_rate_mbps": 10.0,
        "application_delay_s": 0.03,
    },
}


@pytest.mark.parametrize(("old", "new"), list(OLD_KEYS.items()))
def test_an_old_key_is_answered_with_the_new_one(load_text, old, new):
    section, key = old.split(".")
    message = fails(load_text, yaml.safe_dump({section: {key: 3}}))
    if section == "linear_plant":
        assert "linear_plant = " in message
        assert "those of plant now, with plant.model: linear" in message
    elif old == "radio.path_loss":
        assert "must be a mapping with the key `model`" in message
    else:
        assert f"{load_text.path}: {old} = 3: is {new} now" in message


def test_the_linear_plant_is_no_longer_a_matter_of_control(load_text):
    message = fails(load_text, "control: {plant: linear}")
    assert "control.plant = 'linear': is plant.model: linear now" in message


def as_before(scenario):
    """A resolved scenario as it was written before models had names."""
    written = scenario_to_dict(scenario)
    radio, traffic, control = written["radio"], written["traffic"], written["control"]
    path_loss = radio["path_loss"]
    radio["path_loss"] = path_loss.pop("model")
    radio |= {"cell_radius_m": 400.0, "min_distance_m": 35.0, "shadowing_db": 8.0, **path_loss}
    radio["rayleigh_scale"] = radio.pop("fading")["scale"]
    arrivals = traffic.pop("arrivals")
    traffic |= {key: value for key, value in arrivals.items() if key != "model"}
    plant = written.pop("plant")
    names = [key.partition(".")[2] for key in OLD_KEYS if key.startswith("linear_plant.")]
    written["linear_plant"] = {name: plant.get(name) for name in names}
    loop = control.pop("loop")
    control["plant"] = "linear" if plant["model"] == "linear" else loop
    for section, key in (("radio", "report"), ("radio", "link"), ("traffic", "queue")):
        del written[section][key]
    for learning in (written["learning"], *written["learners"].values()):
        del learning["parameters"]
    del written["plugins"], written["policies"]
    return written


@pytest.mark.parametrize("name", ["paper", "smoke", "urban_macro", "linear_plant", "split"])
def test_a_resolved_scenario_of_the_old_form_is_converted(name, config, load_text, monkeypatch):
    monkeypatch.chdir(config.parent)
    if name == "split":
        scenario = load_text("control: {loop: split, method: razumikhin}\n")
    else:
        scenario = load_scenario(config / "scenarios" / f"{name}.yaml")
    old = as_before(scenario)
    assert old["radio"]["path_loss"] in ("none", "macro")
    again, added, sha256 = load_resolved(yaml.safe_dump(old), Path("scenario.yaml"))
    assert again == scenario
    assert set(added) == {
        *("plugins", "policies", "radio.report", "radio.link", "traffic.queue"),
        "learning.parameters",
    }
    assert sha256 != scenario_sha256(scenario)
    assert as_before(again) == old


def test_conversion_leaves_the_new_form_alone(load_text):
    new = scenario_to_dict(load_text("radio: {path_loss: {model: macro}}"))
    assert converted(new) == new


def test_an_older_file_than_a_model_key_takes_the_classes_default(load_text, config, monkeypatch):
    monkeypatch.chdir(config.parent)
    scenario = load_text("radio: {path_loss: {model: macro, cell_radius_m: 300.0}}")
    written = scenario_to_dict(scenario)
    del written["radio"]["path_loss"]["shadowing_db"]
    again, added, _ = load_resolved(yaml.safe_dump(written), Path("scenario.yaml"))
    assert (again, added) == (scenario, ("radio.path_loss.shadowing_db",))


# Policies.

RULE = """
@RULES.model
@dataclass(frozen=True, kw_only=True)
class Tilted(Rule):
    model: Literal["tilted"] = "tilted"
    tilt: Annotated[Positive, Note("1", "assumed", "of the weights")] = 2.0

    def faults(self, scenario):
        return [] if self.tilt < 9 else [f"tilt = {self.tilt}: must be below 9"]

def tail_risk(view, **parameters):
    return view

NUMBER = 3
"""


def test_policies_are_rules_and_functions(load_text, plugin, config):
    path = plugin(RULE)
    scenario = load_text(
        f"plugins: [{path.name}]\npolicies:\n  a: {{model: tilted}}\n"
        f'  b: {{import: "{path.stem}:tail_risk", rule: max_weight, parameters: {{x: [1, 2.5]}}}}\n'
        f'  c: {{import: "{path.stem}:tail_risk"}}\n'
        "evaluate: {policies: [a, pf, b, ddpg]}\n"
    )
    assert scenario.policies["a"].tilt == 2.0
    b = scenario.policies["b"]
    assert (b.source, b.rule, b.parameters) == (
        *(f"{path.stem}:tail_risk", "max_weight"),
        {"x": (1, 2.5)},
    )
    assert isinstance(scenario.policies["c"], ImportedPolicy)
    assert scenario_to_dict(scenario)["policies"] == {
        "a": {"model": "tilted", "tilt": 2.0},
        "b": {
            "rule": "max_weight",
            "parameters": {"x": [1, 2.5]},
            "import": f"{path.stem}:tail_risk",
        },
        "c": {"rule": "pf", "parameters": {}, "import": f"{path.stem}:tail_risk"},
    }
    assert load_text(scenario_to_yaml(scenario)) == scenario
    assert isinstance(hash(scenario), int)
    notes = {note.key: note.unit for note in scenario_notes(scenario, config / "defaults.yaml")}
    assert notes["policies.a.tilt"] == "1"


def test_a_policy_changes_the_jobs_in_which_it_runs(load_text, plugin):
    path = plugin(RULE)

    def values(tilt):
        scenario = load_text(
            f"plugins: [{path.name}]\npolicies: {{a: {{model: tilted, tilt: {tilt}}}}}\n"
            "evaluate: {policies: [a, pf]}\nsweeps: {policies: [pf]}\n"
        )
        return {
            "evaluate": values_of(scenario, "evaluate"),
            "reference": values_of(scenario, "reference"),
            "train": dependencies.train_values(scenario, "ddpg"),
        }

    one, other = values(1.0), values(2.0)
    assert {name for name in one if one[name] != other[name]} == {"evaluate"}


@pytest.mark.parametrize(
    ("entry", "line"),
    [
        ("{rule: pf}", "policies.a = {'rule': 'pf'}: must be a mapping with the key `model`"),
        ("tilted", "policies.a = 'tilted': must be a mapping with the key `model`"),
        ("{model: steep}", "policies.a.model = 'steep': must be one of "),
        ("{model: tilted, lean: 3}", "policies.a.lean = 3: unknown key; allowed: model, tilt"),
        ("{model: tilted, tilt: 0}", "policies.a.tilt = 0: must be greater than 0"),
        ("{model: tilted, tilt: 10}", "policies.a: tilt = 10.0: must be below 9"),
        ('{import: "MINE"}', "policies.a.import = 'MINE'"),
        ('{import: "MINE:f g"}', "policies.a.import = 'MINE:f g'"),
        ('{import: "MINE:none"}', "policies.a.import = 'MINE:none': cannot be imported"),
        (
            '{import: "MINE:tail_rsk"}',
            "cannot be imported: MINE has no tail_rsk; did you mean tail_",
        ),
        ('{import: "no_such:none"}', "policies.a.import = 'no_such:none': cannot be imported"),
        ('{import: "no_such:none"}', "is a plug-in itself: `plugins: [no_such.py]`"),
        ('{import: "MINE:NUMBER"}', "policies.a.import = 'MINE:NUMBER': must be a function"),
        (
            '{import: "MINE:tail_risk", rule: best}',
            "policies.a.rule = 'best': must be one of pf, pf_average",
        ),
        (
            '{import: "MINE:tail_risk", rule: m_lwd}',
            "drift_plus_penalty; did you mean m_lwdf?",
        ),
        ('{import: "MINE:tail_risk", parameters: 3}', "policies.a.parameters = 3"),
        ('{import: "MINE:tail_risk", parameters: {x: {y: 3}}}', "policies.a.parameters.x"),
        (
            '{import: "MINE:tail_risk", weight: 3}',
            "policies.a.weight = 3: unknown key; allowed: import, rule, parameters",
        ),
    ],
)
def test_faults_of_policies(load_text, plugin, entry, line):
    path = plugin(RULE)
    text = f"plugins: [{path.name}]\npolicies: {{a: {entry}}}\n".replace("MINE", path.stem)
    assert line.replace("MINE", path.stem) in fails(load_text, text)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("pf", "policies.pf: the name of a scheduler"),
        ("exact", "policies.exact: the name of a scheduler"),
        ("ddpg", "policies.ddpg: the name of a learner"),
        ("flat", "policies.flat: the name of a learner"),
        ("Mine", "policies.Mine"),
    ],
)
def test_names_of_policies_are_their_own(load_text, plugin, name, line):
    path = plugin(RULE)
    text = (
        f"plugins: [{path.name}]\nlearners: {{flat: {{}}}}\npolicies: {{{name}: {{model: tilted}}}}"
    )
    assert line in fails(load_text, text)


def test_a_policy_that_nobody_adds_is_named(load_text):
    message = fails(load_text, "evaluate: {policies: [pf, mine]}")
    assert "evaluate.policies = ['pf', 'mine']: mine is no policy" in message


def test_no_rules_are_left_behind():
    assert "tilted" not in RULES


# Learners.

LEARNER = """
@ALGORITHMS.register("bandit")
class Bandit:
    @dataclass(frozen=True)
    class Parameters:
        arms: Count
        price: Positive = 1.0

@ALGORITHMS.register("plain")
class Plain:
    pass
"""


def test_an_algorithm_of_a_plugin_has_keys_of_its_own(load_text, plugin):
    path = plugin(LEARNER)
    text = (
        f"plugins: [{path.name}]\nlearning: {{algorithm: bandit, parameters: {{arms: 3}}}}\n"
        "evaluate: {policies: [bandit, pf]}\nsweeps: {policies: [bandit]}\n"
        "generalise: {policies: [bandit]}\n"
    )
    scenario = load_text(text)
    assert list(scenario.learned) == ["bandit"]
    assert scenario.learning.parameters == {"arms": 3}
    assert load_text(scenario_to_yaml(scenario)) == scenario
    for wrong, line in (
        ("{arms: 0}", "learning.parameters.arms = 0: must be greater than or equal to 1"),
        ("{}", "learning.parameters.arms: missing"),
        ("{arms: 3, legs: 2}", "learning.parameters.legs = 2: unknown key"),
    ):
        assert line in fails(load_text, text.replace("{arms: 3}", wrong))


@pytest.mark.parametrize(
    ("learning", "line"),
    [
        ("{algorithm: sarsa}", "learning.algorithm = 'sarsa': must be one of ddpg, a2c"),
        ("{algorithm: pf}", "learning.algorithm = pf: the name of a scheduler"),
        ("{algorithm: 3}", "learning.algorithm = 3: must be a valid string"),
        ("{parameters: {arms: 3}}", "learning.parameters = {'arms': 3}: must be {}: ddpg has no"),
        ("{parameters: 3}", "learning.parameters = 3"),
        ("{algorithm: plain, parameters: {x: 1}}", "must be {}: plain has no own keys"),
    ],
)
def test_faults_of_algorithms(load_text, plugin, learning, line):
    path = plugin(LEARNER)
    assert line in fails(load_text, f"plugins: [{path.name}]\nlearning: {learning}\n")
    learners = f"plugins: [{path.name}]\nlearners: {{other: {learning}}}\n"
    if "scheduler" not in line:
        found = fails(load_text, learners)
        assert line.replace("learning.", "learners.other.", 1) in found


def test_built_in_algorithms_are_found_without_torch(project_root):
    import subprocess

    code = (
        "import sys; from hiersched.scenario import load_scenario; load_scenario('paper'); "
        "assert not {'torch', 'cvxpy', 'hiersched.control'} & set(sys.modules)"
    )
    environment = {"PYTHONPATH": str(project_root / "src"), "PATH": ""}
    subprocess.run([sys.executable, "-c", code], cwd=project_root, env=environment, check=True)


def test_built_in_algorithms_can_be_imported():
    assert [ALGORITHMS[name].__name__ for name in ("ddpg", "a2c")] == ["Ddpg", "A2c"]
