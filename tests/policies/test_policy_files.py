"""Policies in files, of stable-baselines3 and in ONNX: from a scenario to a replayed log."""

from __future__ import annotations

import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from hiersched.cli import main
from hiersched.core.extras import MissingExtraError
from hiersched.core.randomness import world_keys
from hiersched.env import SlicingEnv
from hiersched.experiments import feasible, files
from hiersched.experiments.dependencies import run_values
from hiersched.experiments.feasible import load_study
from hiersched.experiments.gains import design_gains
from hiersched.experiments.points import experiments, groups
from hiersched.experiments.run import run_experiment
from hiersched.experiments.worlds import untrained_policies
from hiersched.log import LogReader
from hiersched.policies.files import ROWS, PolicyFileError
from hiersched.policies.find import find_policy
from hiersched.policies.onnx import open_graph
from hiersched.scenario import ScenarioError, load_resolved, load_scenario, scenario_to_yaml
from hiersched.simulator import Simulator
from hiersched.simulator.loop_gains import nominal_gains
from hiersched.study.metrics import measured_row

CELL = """
name: cell
users: {num_urllc: 2, num_embb: 2}
radio: {bandwidth_hz: 2.0e+6, num_prb: 5}
traffic: {urllc_offered_mbps: [20.0, 30.0]}
control: {max_delay_s: 0.04}
learning: {weight_exponent: 3.0}
evaluate: {seeds: [11], warmup_s: 0.0, duration_s: 0.2, full_logs: 0, policies: [pf]}
sweeps: {seeds: [21], warmup_s: 0.0, duration_s: 0.1, policies: [pf],
         axes: {rayleigh_scale: null, sampling_s: null, service_coefficient_mbps: null,
                reference: null, load_ratio: null, load: {vary: {traffic.load: [0.9]}}}}
generalise: {cells: []}
gain_study: {methods: []}
log: {evaluate_profile: full}
"""
USERS, FEATURES = 4, 8
WAIT, RATE = 2, 3  # places of the features log_wait and log_prb_rate
SLOPE = np.zeros(FEATURES, np.float32)
SLOPE[WAIT], SLOPE[RATE] = 0.25, 0.125  # two exact products: their sum is rounded in one way alone


def write_graph(path, *, flat=False, worlds="worlds", users=USERS, clip=True, features=FEATURES):
    """Write the graph a = clip(observation @ SLOPE); its shape may be fixed or not."""
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper, numpy_helper

    shape = [worlds, users * features] if flat else [worlds, users, features]
    constants = {
        "shape": np.array([-1, users, features]),
        "slope": np.resize(SLOPE, features)[:, None],
        "low": np.float32(-1.0),
        "high": np.float32(1.0),
        "last": np.array([2]),
    }
    nodes = [
        helper.make_node("Reshape", ["observation", "shape"], ["rows"]),
        helper.make_node("MatMul", ["rows", "slope"], ["columns"]),
        helper.make_node("Squeeze", ["columns", "last"], ["sums"]),
        helper.make_node("Clip", ["sums", *(["low", "high"] if clip else [])], ["action"]),
    ]
    graph = helper.make_graph(
        nodes,
        "linear",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, [worlds, users])],
        [numpy_helper.from_array(np.asarray(v), name) for name, v in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Working directory with ``cell.yaml``."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cell.yaml").write_text(CELL, encoding="utf-8")
    return tmp_path


@pytest.fixture
def graph(folder):
    """The path of a linear graph; onnxruntime is there."""
    pytest.importorskip("onnxruntime")
    write_graph(folder / "net.onnx")
    return folder / "net.onnx"


@pytest.fixture(scope="session")
def saved_model(tmp_path_factory):
    """Folder with ``ppo.zip`` and ``sac.zip``, not trained, and ``stats.pkl``."""
    sb3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    folder = tmp_path_factory.mktemp("models")
    (folder / "cell.yaml").write_text(CELL, encoding="utf-8")
    scenario = load_scenario(folder / "cell.yaml")
    env = VecNormalize(DummyVecEnv([lambda: SlicingEnv(scenario, nominal_gains(scenario))]))
    env.reset()
    for _ in range(20):
        env.step(np.zeros((1, USERS), np.float32))
    ppo = sb3.PPO("MlpPolicy", env, seed=3, device="cpu", policy_kwargs={"log_std_init": 0.0})
    ppo.policy.action_net.weight.data *= 100.0  # an untrained one hardly tells users apart
    ppo.save(folder / "ppo.zip")
    sb3.SAC("MlpPolicy", env, seed=3, device="cpu", buffer_size=10).save(folder / "sac.zip")
    env.save(folder / "stats.pkl")
    return folder


def load(folder: Path, policies: str, more: str = ""):
    names = [part.split(":")[0].strip() for part in policies.strip().splitlines()]
    entries = "".join(f"  {line.strip()}\n" for line in policies.strip().splitlines())
    text = f"extends: cell.yaml\nname: mine\npolicies:\n{entries}"
    text += f"evaluate: {{policies: [pf, {', '.join(names)}]}}\n{more}"
    (folder / "mine.yaml").write_text(text, encoding="utf-8")
    return load_scenario(folder / "mine.yaml")


def simulator_of(scenario, count=3, num_slots=40):
    return Simulator(scenario, nominal_gains(scenario), world_keys("files", 1, count), num_slots)


# What a graph decides.


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("worlds", ["worlds", 1, 3])
@pytest.mark.parametrize(("rule", "weighs"), [("pf", "utility"), ("drift_plus_penalty", "drift")])
def test_a_linear_graph_owns_what_the_same_map_in_python_does(graph, flat, worlds, rule, weighs):
    write_graph(graph, flat=flat, worlds=worlds)
    entry = f"net: {{onnx: net.onnx, rule: {rule}, weighs: {weighs}}}"
    scenario = load(graph.parent, entry)
    run = simulator_of(scenario).run("net")
    by_hand = simulator_of(scenario)
    for slot in range(by_hand.num_slots):
        features = by_hand.features(np.zeros((3, 2)))
        action = np.clip(features @ SLOPE, -1.0, 1.0)
        weights = np.exp(3.0 * action.astype(np.float64)).astype(np.float32).astype(np.float64)
        one = by_hand.run(rule, 1, weights=weights, weighs=weighs)
        np.testing.assert_array_equal(run.prb_owner[:, slot], one.prb_owner[:, 0])
        np.testing.assert_array_equal(run.weight[:, slot], one.weight[:, 0])
    unweighed = simulator_of(scenario).run(rule)
    assert (unweighed.prb_owner != run.prb_owner).any()


@pytest.mark.parametrize("kind", ["net", "ppo"])
def test_a_world_has_the_same_bits_in_every_batch(kind, graph, saved_model):
    shutil.copy(saved_model / "ppo.zip", graph.parent)
    scenario = load(graph.parent, "net: {onnx: net.onnx}\nppo: {sb3: ppo.zip}")
    count = ROWS + 3
    whole = simulator_of(scenario, count).run(kind)
    keys = world_keys("files", 1, count)
    for world in (0, 5, ROWS, count - 1):
        alone = Simulator(scenario, nominal_gains(scenario), keys[world : world + 1], 40).run(kind)
        assert alone.weight.tobytes() == whole.weight[world : world + 1].tobytes()
        assert alone.prb_owner.tobytes() == whole.prb_owner[world : world + 1].tobytes()


def test_a_model_of_sb3_predicts_without_noise_on_normalised_observations(saved_model, folder):
    from stable_baselines3 import PPO

    for name in ("ppo.zip", "sac.zip", "stats.pkl"):
        shutil.copy(saved_model / name, folder)
    scenario = load(
        folder,
        """plain: {sb3: ppo.zip}
        normal: {sb3: ppo.zip, vec_normalize: stats.pkl}
        sac: {sb3: sac.zip, algorithm: sac}""",
    )
    features = simulator_of(scenario).features(np.zeros((3, 2)))
    padded = np.zeros((ROWS, USERS, FEATURES), np.float32)
    padded[:3] = features
    model = PPO.load(folder / "ppo.zip")
    plain, normal, sac = (find_policy(scenario, name) for name in ("plain", "normal", "sac"))
    wanted, _ = model.predict(padded, deterministic=True)
    np.testing.assert_array_equal(plain.act(features), wanted[:3])
    stats = pickle.loads((folder / "stats.pkl").read_bytes()).obs_rms
    scaled = np.clip((padded - stats.mean) / np.sqrt(stats.var + 1e-8), -10.0, 10.0)
    wanted, _ = model.predict(scaled.astype(np.float32), deterministic=True)
    np.testing.assert_array_equal(normal.act(features), wanted[:3])
    assert not np.array_equal(wanted[:3], plain.act(features))
    assert (np.abs(sac.act(features)) <= 1.0).all()


# In a study.


def run_study(scenario, results):
    design_gains(scenario, "schedule", results / files.gain_file("schedule"))
    for group in groups(scenario, experiments(scenario)["evaluate"]):
        run_experiment(scenario, results, "evaluate", group, untrained_policies, measured_row)


def test_logs_say_which_file_and_replay_without_opening_it(graph, saved_model, capsys):
    folder = graph.parent
    for name in ("ppo.zip", "stats.pkl"):
        shutil.copy(saved_model / name, folder)
    scenario = load(folder, "net: {onnx: net.onnx}\nppo: {sb3: ppo.zip, vec_normalize: stats.pkl}")
    run_study(scenario, folder / "results")
    logs = {name: f"results/runs/evaluate/{name}/seed11.mcap" for name in ("net", "ppo")}
    for name, key in (("net", "onnx"), ("ppo", "sb3"), ("ppo", "vec_normalize")):
        entry = scenario.policies[name]
        with LogReader(logs[name]) as log:
            assert log.metadata[f"policy_{key}"] == getattr(entry, key)
            assert log.metadata[f"policy_{key}_sha256"] == getattr(entry, f"{key}_sha256")
    for name, log in logs.items():  # asked again, a policy decides to the last bit what it did
        assert main(["replay", log, "--policy", name]) == 0
        assert "every message is the same, bit for bit" in capsys.readouterr().out
    for name in ("net.onnx", "ppo.zip", "stats.pkl"):
        (folder / name).write_bytes(b"another file")
    for log in logs.values():
        assert main(["replay", log]) == 0
        said = capsys.readouterr().out
        assert "every bit the same" in said
        assert "decisions are those of the log" in said
        assert main(["info", log]) == 0
        said = capsys.readouterr().out
        for key, (name, sha256) in scenario.policies[Path(log).parent.name].files.items():
            assert f"policy      {key} {name} (sha256 {sha256[:16]})" in said
    capsys.readouterr()
    open_graph.cache_clear()  # else the graph that this process has opened decides
    for name, log in logs.items():
        assert main(["replay", log, "--policy", name]) != 0
        assert "no such file with the SHA-256" in capsys.readouterr().err


def test_a_changed_file_changes_just_its_jobs(graph):
    folder = graph.parent
    shutil.copy(graph, folder / "other.onnx")
    text = "net: {onnx: net.onnx}\nother: {onnx: other.onnx}"
    sweep = "sweeps: {axes: {load: {vary: {traffic.load: [0.9, 1.0]}, policies: [net, pf]}}}\n"

    def jobs():
        scenario = load(folder, text, sweep)
        return {
            (name, group): run_values(scenario, experiment, group)
            for name, experiment in experiments(scenario).items()
            for group in groups(scenario, experiment)
        }

    before = jobs()
    write_graph(graph, flat=True)
    after = jobs()
    assert {job for job in before if before[job] != after[job]} == {
        ("evaluate", "net"),
        ("load", "net"),
    }
    assert {("evaluate", "classical"), ("evaluate", "other"), ("load", "classical")} < set(after)


def test_a_resolved_scenario_is_the_same_and_needs_no_file_until_it_runs(graph):
    folder = graph.parent
    scenario = load(folder, "net: {onnx: net.onnx, weight_exponent: 2.0}")
    text = scenario_to_yaml(scenario)
    (folder / "sub").mkdir()
    (folder / "sub" / "resolved.yaml").write_text(text, encoding="utf-8")
    assert load_scenario(folder / "sub" / "resolved.yaml") == scenario  # the file is found here
    net = scenario.policies["net"]
    assert (net.rule, net.weighs, net.weight_exponent) == ("pf", "utility", 2.0)
    graph.unlink()
    resolved, added, _ = load_resolved(text, Path("scenario.yaml"))
    assert (resolved, added) == (scenario, ())
    with pytest.raises(PolicyFileError, match=r"policies\.net\.onnx = 'net\.onnx': no such file"):
        find_policy(resolved, "net")


# What cannot be.


def faults_of(folder, policies, more=""):
    try:
        load(folder, policies, more)
        load_study(folder / "mine.yaml")
    except ScenarioError as error:
        return str(error)
    raise AssertionError("no fault")


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("{onnx: nothing.onnx}", "mine.yaml: policies.net.onnx = 'nothing.onnx': cannot be read"),
        ("{onnx: net.onnx, onnx_sha256: '00'}", "must be onnx_sha256 = '00' (or leave"),
        ("{onnx: 3}", "policies.net.onnx = 3: must be a valid string"),
        (
            "{onnx: net.onnx, algorithm: ppo}",
            "policies.net.algorithm = 'ppo': unknown key; allowed: rule, weighs, weight_exponent, "
            "observe_robots, observe_demand, onnx, onnx_sha256",
        ),
        ("{sb3: net.onnx, algorithm: dqn}", "policies.net.algorithm = 'dqn': must be 'a2c'"),
        ("{onnx: net.onnx, rule: edf}", "policies.net.rule = 'edf': must be 'pf'"),
        ("{onnx: net.onnx, weighs: drift}", "policies.net.weighs = drift: must be utility with"),
        ("{onnx: mine.yaml}", "policies.net.onnx = 'mine.yaml': no graph that onnxruntime runs"),
        (
            "{onnx: net.onnx, observe_robots: true}",
            "mine.yaml: evaluate: policies.net.onnx = 'net.onnx': observation of shape (4, 8): "
            "must be (4, 11) or (44,) (4 users, 11 features of each)",
        ),
    ],
)
def test_faults_of_entries_name_file_key_and_what_is_allowed(graph, entry, message):
    assert message in faults_of(graph.parent, f"net: {entry}")


def test_shapes_are_checked_at_every_point_before_anything_runs(graph):
    folder, entry = graph.parent, "net: {onnx: net.onnx}"
    write_graph(graph, users=3)
    found = faults_of(folder, entry)
    assert "observation of shape (3, 8): must be (4, 8) or (32,)" in found
    assert "action of shape (3,): must be (4,) (4 users, 8 features of each)" in found
    write_graph(graph)
    cells = "generalise: {policies: [net], cells: [[2, 3, 6]]}\n"
    assert "generalise u2_e3_k6: policies.net.onnx" in faults_of(folder, entry, cells)
    axis = "sweeps: {{axes: {{net: {{policies: [net], vary: {{policies.net.{}: [{}]}}}}}}}}\n"
    for key, value in (("onnx", "other.onnx"), ("onnx_sha256", "'00'")):
        assert "cannot be varied" in faults_of(folder, entry, axis.format(key, value))
    load(folder, entry, axis.format("weight_exponent", "1.0, 2.0"))
    load_study(folder / "mine.yaml")


def test_spaces_of_a_saved_model_are_read_without_unpickling(saved_model, folder, monkeypatch):
    import cloudpickle

    def refuse(*_, **__):
        raise AssertionError("unpickled")

    shutil.copy(saved_model / "ppo.zip", folder)
    load(folder, "ppo: {sb3: ppo.zip, vec_normalize: cell.yaml}")
    for module in (pickle, cloudpickle):
        monkeypatch.setattr(module, "loads", refuse)
        monkeypatch.setattr(module, "load", refuse)
    load_study(folder / "mine.yaml")
    found = faults_of(folder, "ppo: {sb3: ppo.zip, observe_demand: true}")
    assert "policies.ppo.sb3 = 'ppo.zip': observation of shape (4, 8): must be (4, 14)" in found
    (folder / "no.zip").write_bytes(b"PK")
    assert "no model that stable-baselines3 has saved" in faults_of(folder, "a: {sb3: no.zip}")


def test_a_model_of_another_algorithm_is_named_before_the_first_slot(saved_model, folder):
    for name in ("sac.zip", "ppo.zip"):
        shutil.copy(saved_model / name, folder)
    scenario = load(folder, "a: {sb3: sac.zip}\nb: {sb3: ppo.zip, vec_normalize: cell.yaml}")
    for name, message in (
        ("a", "policies.a.sb3 = 'sac.zip': cannot be loaded with algorithm = 'ppo'"),
        ("b", "policies.b.vec_normalize = 'cell.yaml': cannot be loaded"),
    ):
        with pytest.raises(PolicyFileError) as caught:
            find_policy(scenario, name)
        assert message in str(caught.value)


def test_actions_are_not_clipped(graph):
    write_graph(graph, clip=False)
    model = graph.read_bytes().replace(
        np.float32(0.25).tobytes() + np.float32(0.125).tobytes(),
        np.float32(-90.0).tobytes() + np.float32(70.0).tobytes(),
    )
    graph.write_bytes(model)
    scenario = load(graph.parent, "net: {onnx: net.onnx}")
    with pytest.raises(ValueError, match=r"onnx = 'net.onnx': actions must lie in \[-1, 1\]"):
        simulator_of(scenario).run("net")


def test_a_library_that_is_missing_is_named_with_its_extra(graph, monkeypatch):
    load(graph.parent, "net: {onnx: net.onnx}")
    monkeypatch.setattr(feasible, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"pip install 'hiersched\[onnx\]'"):
        load_study(graph.parent / "mine.yaml")
