"""What the models of a plug-in add is computed again, compared and expanded as all else is."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hiersched.cli import main
from hiersched.control import GainSchedule
from hiersched.core import registry
from hiersched.experiments.files import gain_file
from hiersched.experiments.gains import designs
from hiersched.experiments.logged import load_run, read_slots
from hiersched.experiments.run import run_experiment
from hiersched.experiments.worlds import untrained_policies
from hiersched.log import LogError, LogReader, log_digest
from hiersched.replay.verify import expand, verify
from hiersched.scenario import load_scenario
from hiersched.simulator.gain_source import scenario_key
from hiersched.study.metrics import measured_row

PLUGIN = '''
from dataclasses import dataclass
from typing import Literal, NamedTuple

from hiersched.models.channel.rayleigh import Rayleigh, RayleighWords, draw_rayleigh
from hiersched.models.model import FADING, PLANT
from hiersched.models.plant.unicycle import Unicycle, UnicycleWords, drive_unicycles
from hiersched.models.seams import DRAW_FADING, DRIVE


class Words(NamedTuple):
    inner: RayleighWords
    coherence: int
    lowest: int


@FADING.model
@dataclass(frozen=True, kw_only=True)
class Told(Rayleigh):
    """Rayleigh fading that says what it drew; not a number where a user's first PRB is weak."""

    log_fields = {"coherence": "1", "lowest": "dB"}
    model: Literal["told"] = "told"

    def words(self, setup):
        return Words(super().words(setup), *(setup.first_value(self, f) for f in self.log_fields))


@DRAW_FADING.kernel(Words)
def draw_told(me, constants, state, slot, env):
    draw_rayleigh(me.inner, constants, state, slot, env)
    for user in range(state.fading_power.shape[1]):
        power = state.fading_power[env, user]
        state.model_values[env, me.coherence + user] = power[0] if power[0] > 0.1 else float("nan")
        lowest = power[0]
        for prb in range(1, power.shape[0]):
            lowest = min(lowest, power[prb])
        if lowest > 0.2:
            state.model_values[env, me.lowest + user] = lowest


class RobotWords(NamedTuple):
    inner: UnicycleWords
    speed: int


@PLANT.model
@dataclass(frozen=True, kw_only=True)
class Noted(Unicycle):
    log_fields = {"speed": "m/s"}
    model: Literal["noted"] = "noted"

    def words(self, setup):
        return RobotWords(super().words(setup), setup.first_value(self, "speed"))

    def reset(self, words, keys):
        super().reset(words.inner, keys)


@DRIVE.kernel(RobotWords)
def drive_noted(me, constants, state, slot, env):
    drive_unicycles(me.inner, constants, state, slot, env)
    for robot in range(slot.state.shape[0]):
        state.model_values[env, me.speed + robot] = slot.state[robot, 3]
'''
WANTED = """
name: told
plugins: [{name}.py]
users: {{num_urllc: 2, num_embb: 2}}
radio: {{bandwidth_hz: 2.0e+6, num_prb: 5, fading: {{model: told, scale: 1.0}}}}
plant: {{model: noted}}
traffic: {{urllc_offered_mbps: [20.0, 30.0], load: 1.1}}
control: {{max_delay_s: 0.04}}
robot: {{window_s: 0.1}}
evaluate: {{seeds: [11], warmup_s: 0.0, duration_s: 0.3, full_logs: 0, policies: [pf]}}
gain_study: {{seeds: [31], num_robots: 3, num_windows: 3, violation_windows: [2]}}
log: {{chunk_bytes: 16384}}
"""
LOG = "runs/evaluate/pf/seed11.mcap"
ROBOTS = "runs/gain_study/krasovskii/adjusted/seed31.mcap"


@pytest.fixture(scope="module")
def told(
    study: Path, tmp_path_factory: pytest.TempPathFactory, project_root: Path
) -> Iterator[dict[str, Path]]:
    """Results of the same study by the profile of its evaluation."""
    folder = tmp_path_factory.mktemp("told")
    plugin = folder / "told_by_a_plugin.py"
    plugin.write_text(PLUGIN, encoding="utf-8")
    text = folder / "told.yaml"
    text.write_text(WANTED.format(name=plugin.stem), encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", list(sys.path))
        scenario = load_scenario(
            text, defaults=project_root / "src/hiersched/config" / "defaults.yaml"
        )
        patch.chdir(folder)
        results = {}
        for profile in ("full", "compact", "decisions"):
            results[profile] = folder / profile
            (results[profile] / "gains").mkdir(parents=True)
            designed = {
                name: v
                for name, v in designs(scenario).items()
                if (study / gain_file(name)).exists()
            }
            for name, variant in designed.items():  # the matrices are the same
                gains = GainSchedule.from_json((study / gain_file(name)).read_text())
                text = replace(gains, key=scenario_key(variant)).to_json()
                (results[profile] / gain_file(name)).write_text(text)
            log = replace(scenario.log, evaluate_profile=profile)
            own = replace(scenario, log=log), results[profile]
            run_experiment(*own, "evaluate", "classical", untrained_policies, measured_row)
        own = scenario, results["full"]
        run_experiment(*own, "gain_study", "gains", untrained_policies, measured_row)
        yield results
    sys.modules.pop(plugin.stem, None)
    registry._forget(plugin.resolve())


def flip(slot: int, index: int) -> Callable[[dict, list, dict], None]:
    """Change the last bit of a number: zeros and NaNs too."""

    def change(fields: dict[str, Any], events: list, metadata: dict) -> None:
        fields["model_values"] = fields["model_values"].copy()
        fields["model_values"].view(np.uint64)[slot, index] ^= 1

    return change


def test_a_full_log_has_what_they_wrote(told: dict[str, Path]) -> None:
    with LogReader(told["full"] / LOG) as log:
        assert [(f.name, f.unit) for f in log.model_fields] == [
            ("radio.fading/coherence", "1"), ("radio.fading/lowest", "dB"), ("plant/speed", "m/s"),
        ]  # fmt: skip
        values = log.read_models()
        power = log.read("/channel")["fading_power"]
        speed = log.read("/robots")["state"][:, :, 3]
    lowest = power.min(axis=-1)
    np.testing.assert_array_equal(
        values["radio.fading/coherence"], np.where(power[..., 0] > 0.1, power[..., 0], np.nan)
    )
    np.testing.assert_array_equal(values["radio.fading/lowest"], lowest * (lowest > 0.2))
    np.testing.assert_array_equal(values["plant/speed"], speed)
    assert values["radio.fading/lowest"].any()
    assert np.isnan(values["radio.fading/coherence"]).any()


@pytest.mark.parametrize("profile", ["full", "compact", "decisions"])
def test_every_profile_is_computed_again_and_becomes_the_full_log(
    profile: str, told: dict[str, Path], tmp_path: Path
) -> None:
    run = load_run(told[profile] / LOG)
    assert run.profile == profile
    assert verify(run) is None
    assert expand(run, tmp_path / "full.mcap") is None
    assert log_digest(tmp_path / "full.mcap") == log_digest(told["full"] / LOG)
    assert verify(load_run(tmp_path / "full.mcap")) is None
    with LogReader(tmp_path / "full.mcap") as log:
        assert [field.name for field in log.model_fields][2] == "plant/speed"


@pytest.mark.parametrize(
    ("index", "name"),
    [(3, "radio.fading/coherence[3]"), (5, "radio.fading/lowest[1]"), (9, "plant/speed[1]")],
)
@pytest.mark.parametrize("profile", ["full", "compact"])
def test_a_changed_bit_is_named(
    profile: str, index: int, name: str, told: dict[str, Path], tmp_path: Path, rewrite: Any
) -> None:
    path = rewrite(told[profile] / LOG, tmp_path / "a.mcap", flip(17, index))
    found = verify(load_run(path))
    assert found is not None
    assert (found.slot, found.topic, found.field) == (17, "/models", name)
    assert f"slot 17, topic /models, field {name}: " in str(found)


def test_robots_alone_have_those_of_the_plant(
    told: dict[str, Path], tmp_path: Path, rewrite: Any
) -> None:
    run = load_run(told["full"] / ROBOTS)
    assert run.profile == "robots"
    assert expand(run, tmp_path / "full.mcap") is None
    with LogReader(tmp_path / "full.mcap") as log:
        values = log.read_models()
        np.testing.assert_array_equal(values["plant/speed"], log.read("/robots")["state"][..., 3])
    assert values["plant/speed"].any()
    assert not values["radio.fading/coherence"].any()
    path = rewrite(tmp_path / "full.mcap", tmp_path / "a.mcap", flip(8, -1))
    found = verify(load_run(path))
    assert found is not None
    assert (found.slot, found.field) == (8, "plant/speed[2]")


def test_studies_read_them_from_any_log(
    told: dict[str, Path], tmp_path: Path, rewrite: Any
) -> None:
    names = ["model_values", "hol_delay_s"]
    full = read_slots(told["full"] / LOG, names).fields
    assert full["model_values"].shape == (30, 10)
    for profile in ("compact", "decisions"):
        small = read_slots(told[profile] / LOG, names).fields
        assert {name: small[name].tobytes() for name in names} == {
            name: full[name].tobytes() for name in names
        }
    path = rewrite(told["compact"] / LOG, tmp_path / "a.mcap", flip(17, 3))
    with pytest.raises(LogError, match="its model_values does not follow from its decisions"):
        read_slots(path, names)


def test_logs_without_them_have_none(study: Path) -> None:
    fields = read_slots(
        study / "runs/evaluate/pf/seed11.mcap", ["model_values", "rate_mbps"]
    ).fields
    assert fields["model_values"].shape == (len(fields["rate_mbps"]), 0)


def test_commands(told: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    log, out = told["decisions"] / LOG, tmp_path / "full.mcap"
    assert main(["replay", str(log), "--out", str(out)]) == 0
    assert main(["replay", str(out), "--policy", "m_lwdf"]) == 0
    assert main(["compare", str(out), str(told["full"] / LOG)]) == 0
    assert main(["export", str(out), "--csv", "--out", str(tmp_path / "tables")]) == 0
    assert main(["export", str(out), "--viewer", "--out", str(tmp_path / "viewer")]) == 0
    capsys.readouterr()
    for path, topic in ((log, False), (out, True)):
        assert main(["info", str(path)]) == 0
        text = capsys.readouterr().out
        assert "models      radio.fading/coherence [1] (4), " in text
        assert ("\n/models " in text) is topic
    header = (tmp_path / "tables/models.csv").read_text().splitlines()[0].split(",")
    assert header[2:4] == ["radio.fading/coherence[0]", "radio.fading/coherence[1]"]
