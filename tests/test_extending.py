"""The pages of docs/extending: each runs from top to bottom, and each of its plug-ins in a study.

A page has one Python file, one scenario and one run, in this order.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytest
import yaml
from numba.core.caching import _CacheLocator

from hiersched.cli import main
from hiersched.core import registry
from hiersched.core.compiled import CACHE_FOLDER
from hiersched.core.randomness import world_keys
from hiersched.experiments import files
from hiersched.experiments.gains import design_gains
from hiersched.experiments.points import experiments, learner_scenario
from hiersched.experiments.run import run_experiment
from hiersched.experiments.worlds import untrained_policies
from hiersched.scenario import Scenario, load_scenario
from hiersched.simulator import Simulator
from hiersched.simulator.check import ModelCheckError, check_models
from hiersched.simulator.loop_gains import nominal_gains
from hiersched.study.metrics import measured_row

FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PAGES = ("scheduler", "channel", "traffic", "plant", "learner")
MODELS = PAGES[:-1]

TINY = """
name: tiny
users: {num_urllc: 2, num_embb: 2}
radio: {bandwidth_hz: 2.0e+6, num_prb: 5}
traffic: {urllc_offered_mbps: [20.0, 30.0]}
control: {max_delay_s: 0.04}
learning: {seeds: [1, 2], episodes: 8, slots_per_episode: 12, num_envs: 4, hidden: [8],
           batch_size: 8, warmup_slots: 4}
evaluate: {seeds: [11], warmup_s: 0.0, duration_s: 0.2, full_logs: 0, policies: [pf]}
sweeps: {seeds: [21], warmup_s: 0.0, duration_s: 0.1, policies: [pf],
         axes: {rayleigh_scale: null, sampling_s: null, service_coefficient_mbps: null,
                reference: {vary: {robot.reference: [arc]}}, load: {vary: {traffic.load: [0.9]}},
                load_ratio: {vary: {traffic.load_ratio: [1.0]}}}}
generalise: {seeds: [41], warmup_s: 0.0, duration_s: 0.1, policies: [pf], cells: [[3, 2, 6]]}
gain_study: {seeds: [31], num_robots: 3, num_windows: 3, violation_windows: [2],
             sampling_s: [0.02]}
log: {evaluate_profile: full}
"""


class Blocks(NamedTuple):
    """What a page consists of, and where."""

    file: str
    code: str
    scenario: str
    run: str
    line_above: int  # the run


def read_page(project_root: Path, page: str) -> Blocks:
    text = (project_root / f"docs/extending/{page}.md").read_text(encoding="utf-8")
    blocks = [match for match in FENCE.finditer(text) if match[1]]
    assert [block[1] for block in blocks] == ["python", "yaml", "python"], page
    code, scenario, run = (block[2] for block in blocks)
    file = re.match(r"# (\w+\.py)\n", code)
    assert file, page
    assert scenario.startswith("# mine.yaml\n")
    return Blocks(file[1], code, scenario, run, text.count("\n", 0, blocks[2].start(2)))


def merged(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    result = dict(base)
    for key, value in over.items():
        old = result.get(key)
        both = isinstance(old, dict) and isinstance(value, dict)
        result[key] = merged(old, value) if both else value
    return result


@pytest.fixture
def folder(project_root, tmp_path, monkeypatch):
    """Working directory; what is plugged in here is gone afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path
    for file in tmp_path.glob("*.py"):
        if sys.modules.pop(file.stem, None):
            registry._forget(file.resolve())
        compiled = _CacheLocator.get_suitable_cache_subpath(str(file))
        shutil.rmtree(CACHE_FOLDER / compiled, ignore_errors=True)


@pytest.fixture
def tiny_with(project_root, folder):
    """Return the scenario of pages, small; `edits` are (old, new) in the file of the plug-in."""

    def load(*pages: str, edits: tuple[tuple[str, str], ...] = (), **over: Any) -> Scenario:
        text = yaml.safe_load(TINY)
        for page in pages:
            blocks = read_page(project_root, page)
            code = blocks.code
            for old, new in edits:
                assert old in code, old
                code = code.replace(old, new)
            (folder / blocks.file).write_text(code, encoding="utf-8")
            of_page = yaml.safe_load(blocks.scenario)
            del of_page["name"]
            of_page.pop("evaluate", None)
            of_page["plugins"] = [*text.get("plugins", []), *of_page["plugins"]]
            text = merged(text, of_page)
        path = folder / "tiny.yaml"
        path.write_text(yaml.safe_dump(merged(text, over)), encoding="utf-8")
        return load_scenario(path)

    return load


def run_python(folder: Path, project_root: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(project_root / "src")},
        capture_output=True,
        text=True,
        check=False,
    )


# The pages.


@pytest.mark.nightly
@pytest.mark.parametrize("page", PAGES)
def test_a_page_runs_from_top_to_bottom(page, project_root, folder):
    """As a reader would: files in a folder, a new process. A failure names the page's line."""
    blocks = read_page(project_root, page)
    (folder / blocks.file).write_text(blocks.code, encoding="utf-8")
    (folder / "mine.yaml").write_text(blocks.scenario, encoding="utf-8")
    run = "\n" * blocks.line_above + blocks.run
    (folder / f"{page}.md").write_text(run, encoding="utf-8")
    done = run_python(folder, project_root, f"{page}.md")
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()
    experiments(load_scenario("mine.yaml"))  # the whole study could run


def test_every_page_is_run(project_root):
    written = {path.stem for path in (project_root / "docs/extending").glob("*.md")}
    assert written == {"README", "shown", "own_policy", *PAGES}  # shown: tests/test_docs.py
    index = (project_root / "docs/extending/README.md").read_text(encoding="utf-8")
    assert "```python" not in index
    for page in (*PAGES, "own_policy"):
        assert f"]({page}.md)" in index


def test_streams_of_the_pages_are_free_and_different(project_root):
    found = []
    for page in PAGES:
        code = read_page(project_root, page).code
        found += map(int, re.findall(r"^STREAM\w* = np\.uint32\((\d+)\)$", code, re.MULTILINE))
    assert len(set(found)) == len(found) > 3
    assert min(found) >= 64


# The plug-ins.


POLICY = {"scheduler": "steep"}


@pytest.mark.nightly
@pytest.mark.parametrize("page", MODELS)
def test_batches_of_one_and_three_give_the_same_bits(page, tiny_with):
    scenario, policy = tiny_with(page), POLICY.get(page, "pf")
    gains, keys = nominal_gains(scenario), world_keys("batch", 1, 3)
    whole = Simulator(scenario, gains, keys, 30).run(policy)
    assert len(np.unique(whole.rows[:, :, :].reshape(3, -1), axis=0)) == 3
    for world in range(3):
        alone = Simulator(scenario, gains, keys[world : world + 1], 30).run(policy)
        for name, values in alone.environment(0).items():
            assert values.tobytes() == whole.environment(world)[name].tobytes(), name


@pytest.mark.nightly
@pytest.mark.parametrize("page", MODELS)
def test_models_keep_the_rules(page, tiny_with):
    check_models(tiny_with(page), (POLICY.get(page, "pf"), "round_robin"), 60)


def replays(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(log)]) == 0
    assert "slots computed again, every bit the same" in capsys.readouterr().out


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("pages", "policies"),
    [
        (("scheduler",), ["steep", "mine"]),
        (("channel",), ["pf"]),
        (("traffic",), ["drift_plus_penalty"]),
        (("plant",), ["edf"]),
        (("scheduler", "channel", "traffic", "plant"), ["steep"]),
    ],
)
def test_a_log_of_a_plugin_replays(pages, policies, tiny_with, folder, capsys):
    scenario = tiny_with(*pages, evaluate={"policies": policies})
    results = folder / "results"
    design_gains(scenario, "schedule", results / files.gain_file("schedule"))
    run_experiment(scenario, results, "evaluate", "classical", untrained_policies, measured_row)
    for policy in policies:
        replays(results / f"runs/evaluate/{policy}/seed11.mcap", capsys)


@pytest.mark.nightly
def test_the_learner_trains_runs_and_replays(tiny_with, folder, capsys):
    from hiersched.experiments.learned import learned_policies
    from hiersched.experiments.train import train_and_log
    from hiersched.learning.trainer import train

    study = tiny_with("learner", evaluate={"policies": ["evolved"]})
    scenario = learner_scenario(study, "evolved")
    gains, keys = nominal_gains(scenario), world_keys("batch", 1, 3)
    policy, other = train(scenario, gains, show=False)
    assert not np.array_equal(policy.parameters, other.parameters)
    whole = Simulator(scenario, gains, keys, 30).run(policy)
    assert np.ptp(whole.weight) > 0.0
    alone = Simulator(scenario, gains, keys[1:2], 30).run(policy)
    assert alone.weight.tobytes() == whole.weight[1:2].tobytes()
    learned_alone = replace(scenario, learning=replace(scenario.learning, seeds=(2,)))
    (same,) = train(learned_alone, gains, show=False)
    np.testing.assert_allclose(same.parameters, other.parameters, rtol=0, atol=1e-5)

    results = folder / "results"
    design_gains(study, "schedule", results / files.gain_file("schedule"))
    train_and_log(study, "evolved", results, "code", show=False)
    source = learned_policies([results / name for name in files.policy_files(study, "evolved")])
    run_experiment(study, results, "evaluate", "evolved", source, measured_row)
    replays(results / "runs/evaluate/evolved/seed11.mcap", capsys)


@pytest.mark.nightly
def test_an_edited_plugin_is_compiled_anew(tiny_with, folder):
    """Even one whose file keeps its size and its time: the index of Numba's cache sees no more."""
    scenario = tiny_with("channel")
    file, keys = folder / "my_channel.py", world_keys("edit", 1, 1)
    stat = file.stat()
    before = Simulator(scenario, nominal_gains(scenario), keys, 5).run("pf").fading_power
    tiny_with("channel", edits=(("power += part * part", "power -= part * part"),))
    os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert file.stat().st_size == stat.st_size
    edited = load_scenario("tiny.yaml")
    after = Simulator(edited, nominal_gains(edited), keys, 1).state.fading_power
    np.testing.assert_array_equal(after[0], -before[0, 0])


# What the tables of mistakes say.

MISTAKES = {
    "scheduler": [
        (
            "urgency = exp_f64(me.slope * wait)",
            "urgency = -1.0",
            "weight that is negative or not",
        ),
        (
            'model: Literal["urgent"] = "urgent"',
            'model: Literal["urgent"] = "urgent"\n    allocation = "maximum"',
            "allocation = 'maximum': must be one of log,",
        ),
        (
            'model: Literal["urgent"] = "urgent"',
            'model: Literal["urgent"] = "urgent"\n    allocation = "own"',
            "UrgentWords has no kernel for the seam allocation of a rule:",
        ),
        (
            'model: Literal["urgent"] = "urgent"',
            'model: Literal["urgent"] = "urgent"\n    allocation = "capped"',
            "a rule gave a user a need that is negative or not a number, or none",
        ),
        (
            "view: View, level: float, price: float",
            "view: View, level: float",
            "got an unexpected keyword argument 'price'",
        ),
    ],
    "channel": [
        (
            "def words(",
            "def other(",
            "my_channel.Flat: its `words` returns None: must be the NamedTuple of "
            "its kernel for the seam radio.fading",
        ),
        (
            "@DRAW_FADING.kernel(FlatWords)\n",
            "",
            "my_channel.py: FlatWords has no kernel for the seam radio.fading:",
        ),
        (
            "draw_flat(me, constants, state, slot, env)",
            "draw_flat(me, state, env)",
            "a kernel of the seam radio.fading must be draw_flat(me, constants, state, slot, env)",
        ),
        (
            "state.fading_power[env, user, prb] =",
            "state.fading[env, user, prb] =",
            "does not compile: SlotState has no field 'fading'; its fields are key, slot, ",
        ),
        (
            "        power = 0.0\n",
            "        power = 0.0\n        me.correlation *= 0.9\n",
            "a kernel cannot change a number: keep what evolves in an array",
        ),
        (
            "        power = 0.0\n",
            "        power = 0.0\n        np.zeros(2)[0] = 1.0\n",
            "a kernel cannot make arrays: work arrays belong to its words",
        ),
        (
            "normal=np.zeros((2, num_users), np.float32)",
            "normal=[0.0]",
            "FlatWords.normal is of type list: must be a number, a NumPy array, or "
            "a NamedTuple of these",
        ),
        (
            "np.sqrt(square)",
            "np.sqrt(square[:1])",
            ": must be positive and finite, shape (4,)",
        ),
        (
            "draw_uniforms(np.uint64(key), STREAM_PLACE, 0, 0, uniform)",
            "uniform[:] = np.random.uniform(size=num_users)",
            "rate_mbps: a second run of the same worlds differs, under pf (first in slot 0)",
        ),
        (
            "keep = me.correlation if now > 0 else 0.0",
            "keep = me.correlation",
            "words.part[...] = 0.0",
            "pass",
            "fading_power: `reset` leaves something of the episode before (first in slot 0)",
        ),
        (
            "range(state.fading_power.shape[2])",
            "range(state.fading_power.shape[2] - 1)",
            "fading_power: not written in every slot (first in slot 1)",
        ),
        (
            "= F32(power)",
            "= -F32(power)",
            "fading_power: -1.22 in slot 0",
        ),
    ],
    "traffic": [
        (
            "        slot.arrival_clamped[user] = 0\n",
            "",
            "arrival_clamped: not written in every slot (first in slot 0)",
        ),
        (
            "me.on[env, user] == 1",
            "me.on[0, user] == 1",
            "me.on[env, user] = 1",
            "me.on[0, user] = 1",
            "arrivals_packets: slots one by one are others than in one call",
        ),
        (
            "mean_due_packets=offered_mbps * packets_per_mbps",
            "mean_due_packets=np.array([1.0])",
            "my_traffic.OnOff.belief: mean_due_packets = [1.]: must be finite and not negative",
        ),
    ],
    "plant": [
        (
            "return 4, 2, 4",
            "return 5, 2, 4",
            "local_gains: shape (3, 2, 4), must be (3, 2, 5)",
        ),
        (
            "np.eye(4)[:, 2:]",
            "np.zeros((4, 2))",
            "(A, B) is not stabilisable: no input moves the mode of A at 1",
        ),
        (
            "slot.state[robot, j] = body[j]",
            "slot.state[robot, j] = body[j] / (robot - robot)",
            "the state of a robot is not finite",
        ),
        (
            "        forget(words.memory)\n",
            "",
            "gain_delay_steps: `reset` leaves something of the episode before",
        ),
    ],
}
"""Page -> old and new text of its file, by turns, and what the message holds."""

CASES = [(page, mistake) for page, mistakes in MISTAKES.items() for mistake in mistakes]


@pytest.mark.nightly
@pytest.mark.parametrize(("page", "mistake"), CASES)
def test_a_mistake_gives_its_message(page, mistake, tiny_with, project_root):
    *texts, message = mistake
    edits = tuple(zip(texts[::2], texts[1::2], strict=True))
    policies = ("steep" if page == "scheduler" else "pf", "round_robin")
    with pytest.raises((TypeError, ValueError)) as caught:
        check_models(tiny_with(page, edits=edits), policies, 40)
    assert message in str(caught.value)


@pytest.mark.parametrize(("page", "mistake"), CASES)
def test_a_message_stands_on_its_page(page, mistake, project_root):
    """But for numbers, which are those of a larger cell there."""
    text = (project_root / f"docs/extending/{page}.md").read_text(encoding="utf-8")
    assert re.sub(r"\d+", "0", mistake[-1]) in re.sub(r"\d+", "0", text)


@pytest.mark.nightly
def test_draws_that_a_decision_changes_are_found(tiny_with):
    edit = "fresh * np.float64(", "fresh * (1.0 + slot.prb_owner[0]) * np.float64("
    with pytest.raises(ModelCheckError, match="decisions of pf and round_robin change the draws"):
        check_models(tiny_with("channel", edits=(edit,)), num_slots=10)


# The pipeline.


@pytest.mark.nightly
def test_snakemake_runs_a_study_of_plugins(tiny_with, folder, project_root, capsys):
    """Gains, kernels and the evaluation of a study with four plug-ins; the rest is planned."""
    scenario = tiny_with("scheduler", "channel", "traffic", evaluate={"policies": ["steep", "pf"]})
    log = f"results/{scenario.name}/runs/evaluate/steep/seed11.mcap"
    snakemake = ("-m", "snakemake", "--snakefile", str(project_root / "workflow/Snakefile"))
    given = ("--config", "scenarios=[tiny.yaml]")
    done = run_python(folder, project_root, *snakemake, "--cores", "1", log, *given)
    assert done.returncode == 0, done.stderr
    replays(folder / log, capsys)
    planned = run_python(folder, project_root, *snakemake, "-n", *given)
    assert planned.returncode == 0, planned.stderr
    assert "measure_classical" in planned.stdout + planned.stderr
    assert "evaluate_classical" not in planned.stdout + planned.stderr
    rules = folder / "my_rules.py"
    rules.write_text(rules.read_text(encoding="utf-8") + "\n# edited\n", encoding="utf-8")
    again = run_python(folder, project_root, *snakemake, "-n", *given)
    assert "evaluate_classical" in again.stdout + again.stderr


@pytest.mark.nightly
def test_a_policy_of_another_library_joins_a_study(project_root, folder, capsys):
    """The files of the page, its training and its study; PPO has learnt, in both of its forms."""
    for package in ("stable_baselines3", "onnxruntime", "onnxscript"):
        pytest.importorskip(package)
    page = (project_root / "docs/extending/own_policy.md").read_text(encoding="utf-8")
    for block in FENCE.finditer(page):
        if block[1]:
            file = re.match(r"# (\S+)\n", block[2])
            assert file, block[2]
            (folder / file[1]).write_text(block[2], encoding="utf-8")
    trained = run_python(folder, project_root, "train.py")
    assert trained.returncode == 0, trained.stderr
    study = ("-m", "hiersched.cli", "run", "mine.yaml", "--cores", "1")
    done = run_python(folder, project_root, *study)
    assert done.returncode == 0, done.stdout + done.stderr
    table = pd.read_csv("results/mine/tables/policies.csv").set_index("policy")
    late = table["urllc_late_share"]
    assert late["ppo"] < 0.5 * late["pf"]
    assert late["net"] == pytest.approx(late["ppo"], rel=0.05)
    assert Path("results/mine/figures/fig8_violations.png").stat().st_size > 10_000
    for policy in ("ppo", "net"):
        replays(Path(f"results/mine/runs/evaluate/{policy}/seed101.mcap"), capsys)
    with open("ppo.onnx", "ab") as graph:
        graph.write(b"\x32\x00")  # one more text, empty, about the graph: it stays valid
    again = run_python(folder, project_root, *study, "--snakemake=-n")
    assert again.returncode == 0, again.stdout + again.stderr
    planned = set(re.findall(r"^(\w+)_mine +1$", again.stdout + again.stderr, re.MULTILINE))
    assert {"evaluate_net", "measure_net", "table_policies"} <= planned
    assert not planned & {
        f"{job}_{p}" for job in ("evaluate", "measure") for p in ("ppo", "classical")
    }
