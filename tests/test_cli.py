from __future__ import annotations

import os
import shlex
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from hiersched.cli import main
from hiersched.core.extras import EXTRA_OF
from hiersched.log import LogReader
from hiersched.scenario import load_scenario
from hiersched.scenario.plugins import CONFIG

SHIPPED = sorted((CONFIG / "scenarios").glob("*.yaml"))


@pytest.fixture(autouse=True)
def in_project(project_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(project_root)


@pytest.mark.parametrize("path", SHIPPED, ids=str)
def test_every_scenario_of_the_project_is_fine(path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["scenario", "check", str(path)]) == 0
    assert f"scenario {path.stem} is fine" in capsys.readouterr().out


def test_show_prints_what_loads_to_the_same(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["scenario", "show", "smoke"]) == 0
    path = tmp_path / "shown.yaml"
    path.write_text(capsys.readouterr().out, encoding="utf-8")
    assert load_scenario(path) == load_scenario("smoke")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("radio: {num_prbs: 3}", "radio.num_prbs = 3: unknown key; allowed: slot_s, "),
        ("radio: {tx_power_dbm: 1e1}", "write 1.0e-3"),
        ("users: {num_urllc: 40}", "at most radio.num_prb = 25"),
        ("control: {sampling_s: 0.03}", "control.sampling_s = 0.03"),
        ("radio: {num_prb: 3", "not valid YAML"),
        ("traffic: {load: -1}", "traffic.load = -1"),
        ("- 1", "a scenario is a mapping of sections"),
    ],
)
def test_a_fault_is_one_message(
    tmp_path: Path, capsys: pytest.CaptureFixture, text: str, message: str
) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(f"{text}\n", encoding="utf-8")
    for action in ("check",) if message.startswith("sweeps") else ("check", "show"):
        assert main(["scenario", action, str(path)]) == 2
        output = capsys.readouterr()
        assert output.out == ""
        assert message in output.err
        assert "Traceback" not in output.err


def test_a_missing_file_names_those_that_exist(capsys: pytest.CaptureFixture) -> None:
    assert main(["scenario", "check", "papper"]) == 2
    there = ", ".join(path.stem for path in SHIPPED)
    assert "paper, pendulum, smoke" in there
    assert f"no such scenario; there are: {there}" in capsys.readouterr().err


def test_the_installed_command(project_root: Path) -> None:
    def run(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "hiersched.cli", *words],
            capture_output=True,
            text=True,
            check=False,
        )

    assert run("--version").stdout == f"hiersched {version('hiersched')}\n"
    usage = run("scenario")
    assert (usage.returncode, "usage: hiersched" in usage.stderr) == (2, True)


def test_one_world_is_a_table_and_a_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["run", "smoke", "--policy", "pf", "--seconds", "2", "--seed", "7"]) == 0
    said = capsys.readouterr().out
    for words in ("pf in world 7, 2 s behind a warm-up of 1 s", "late packets", "delay, 99.9 %"):
        assert words in said
    path = Path("results/smoke/worlds/pf_seed7.mcap")
    assert said.endswith(f"{path}\n")
    with LogReader(path) as log:
        assert (log.num_slots, log.profile) == (300, "full")
    assert main(["replay", str(path)]) == 0
    assert main(["run", "smoke", "--policy", "pf", "--seconds", "1", "--out", "a/b.mcap"]) == 0
    assert Path("a/b.mcap").is_file()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["smok", "--policy", "pf"], "no such scenario; there are: "),
        (["smoke", "--policy", "ddpg"], "policy = 'ddpg': must be one of pf, "),
        (["smoke", "--policy", "ddpg"], "exact; the study trains learners"),
        (["smoke", "--policy", "pf", "--seconds", "0"], "--seconds 0: must be a slot of 0.01 s"),
        (["smoke", "--policy", "pf", "--seconds", "nan"], "--seconds nan: must be"),
        (["smoke", "--policy", "pf", "--snakemake=-n"], "--snakemake: only with --cores"),
        (["smoke", "--cores", "1", "--seed", "0"], "--seed: only with --policy"),
    ],
)
def test_what_cannot_run_is_one_message(
    words: list[str], message: str, capsys: pytest.CaptureFixture
) -> None:
    assert main(["run", *words]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.nightly
def test_a_study_is_snakemakes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture
) -> None:
    folder = tmp_path / "a, b"
    folder.mkdir()
    monkeypatch.chdir(folder)
    assert main(["run", "smoke", "--cores", "1", "--snakemake=-n --quiet all"]) == 0
    said = "".join(capfd.readouterr())
    assert f"Working directory: {folder}" in said
    assert "evaluate_classical_smoke" in said
    Path("it's mine.yaml").write_text("name: mine\nlearning: {seeds: []}\n", encoding="utf-8")
    assert main(["run", "it's mine.yaml", "--cores", "1"]) == 1
    assert "error: it's mine.yaml: learning.seeds" in "".join(capfd.readouterr())


@pytest.mark.nightly
def test_a_new_folder_runs_as_its_readme_says(tmp_path: Path, project_root: Path) -> None:
    """In processes of their own: a plug-in stays where it has been imported."""

    def run(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            f"{shlex.quote(sys.executable)} -m hiersched.cli {command}",
            shell=True,
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(project_root / "src")},
            capture_output=True,
            text=True,
            check=False,
        )

    assert run("new study", tmp_path).returncode == 0
    assert "study: not empty; nothing is overwritten" in run("new study", tmp_path).stderr
    readme = (tmp_path / "study/README.md").read_text(encoding="utf-8")
    commands = [line.split("   ")[0] for line in readme.split("    hiersched ")[1:]]
    study = "run mine.yaml --cores 2"
    assert study in commands
    for command in commands:
        command += " --snakemake='-n --quiet all'" * (command == study)
        done = run(command, tmp_path / "study")
        assert done.returncode == 0, (command, done.stderr)


CORE_ONLY = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name in {packages}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Missing())
import numpy as np
from hiersched.cli import main
from hiersched.env import SlicingVectorEnv
from hiersched.scenario import load_scenario

env = SlicingVectorEnv(load_scenario("smoke"), num_envs=2)
env.reset(seed=1)
reward = env.step(np.zeros(env.action_space.shape, np.float32))[1]
assert reward.shape == (2,), reward
for words in {commands}:
    print(main(words), file=sys.stderr)
for statement in {statements}:
    try:
        exec(statement)
    except ImportError as error:
        print(error, file=sys.stderr)
"""


def test_the_core_does_without_the_extras(tmp_path: Path, project_root: Path) -> None:
    """Simulates, logs and is an environment; what it cannot do names the extra."""
    (tmp_path / "other.yaml").write_text("control: {weight: 90.0}\n", encoding="utf-8")
    log = "results/smoke/worlds/pf_seed101.mcap"
    commands = {
        ("run", "smoke", "--policy", "pf", "--seconds", "1"): None,
        ("replay", log): None,
        (
            "run",
            "other.yaml",
            "--policy",
            "pf",
        ): "cvxpy, which is not installed: pip install 'hiersched[control]'",
        (
            "run",
            "smoke",
            "--cores",
            "1",
        ): "snakemake, which is not installed: pip install 'hiersched[study]'",
        ("export", log, "--csv"): "pandas, which is not installed: pip install 'hiersched[study]'",
    }
    statements = {
        f"from hiersched.log import *; topic_frame(LogReader({log!r}), '/queue')":
        "pandas, which is not installed: pip install 'hiersched[study]'",
        f"from hiersched.replay.view import show_in_rerun; show_in_rerun({log!r})":
        "rerun, which is not installed: pip install 'hiersched[viewer]'",
        "import hiersched.learning.trainer":
        "torch, which is not installed: pip install 'hiersched[learn]'",
        "import hiersched.study.tables.policies":
        "pandas, which is not installed: pip install 'hiersched[study]'",
        "from hiersched.study.figures.style import policy_look":
        "matplotlib, which is not installed: pip install 'hiersched[study]'",
        "import hiersched.study.across":
        "pandas, which is not installed: pip install 'hiersched[study]'",
        "from hiersched.control import analyse_krasovskii":
        "cvxpy, which is not installed: pip install 'hiersched[control]'",
        "from hiersched.env import SlicingParallelEnv":
        "pettingzoo, which is not installed: pip install 'hiersched[pettingzoo]'",
    }  # fmt: skip
    code = CORE_ONLY.format(
        packages=set(EXTRA_OF),
        commands=[list(words) for words in commands],
        statements=list(statements),
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(project_root / "src")},
    )
    assert done.returncode == 0, done.stderr
    said = [line for line in done.stderr.splitlines() if "compiling" not in line]
    expected = []
    for message in commands.values():
        expected += ["0"] if message is None else [f"hiersched: this needs {message}", "2"]
    assert said == expected + [f"this needs {message}" for message in statements.values()]
