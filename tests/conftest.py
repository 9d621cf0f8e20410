"""Shared settings: one thread, no display, repeatable property tests."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

# Before NumPy loads: the bits of a matrix product depend on the number of threads.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
os.environ.setdefault("MPLBACKEND", "Agg")

import numpy as np  # noqa: E402
import pytest  # noqa: E402
from hypothesis import HealthCheck, settings  # noqa: E402

if TYPE_CHECKING:
    from hiersched.scenario import Scenario
    from hiersched.simulator.loop_gains import Gains

# Compiling a Numba kernel takes seconds on its first call, so no deadline;
# derandomised, so that a run that passes here passes everywhere.
settings.register_profile(
    "hiersched",
    deadline=None,
    derandomize=True,
    max_examples=50,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("hiersched")


WITHOUT_TORCH = find_spec("torch") is None
"""Then tests that need it are skipped: `make pythons`."""
_LEARNS = re.compile(
    r"^(import torch|from torch|from hiersched\.(learning|experiments\.train)\b)", re.MULTILINE
)


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Leave out files and folders that need torch to be imported, where there is none."""
    code = collection_path / "conftest.py" if collection_path.is_dir() else collection_path
    if not WITHOUT_TORCH or code.suffix != ".py" or not code.is_file():
        return None
    return bool(_LEARNS.search(code.read_text(encoding="utf-8"))) or None


def _skipping_without_torch(item: pytest.Item) -> Generator[None, object, object]:
    try:
        return (yield)
    except ImportError as error:  # MissingExtraError among them
        if WITHOUT_TORCH and (error.name or "").partition(".")[0] in ("torch", "stable_baselines3"):
            pytest.skip("needs torch")
        raise


pytest_runtest_setup = pytest.hookimpl(wrapper=True)(_skipping_without_torch)
pytest_runtest_call = pytest.hookimpl(wrapper=True)(_skipping_without_torch)


LONGEST_FIRST = ("study", "control", "experiments", "learning", "simulator", "replay", "log")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keep the tests of a folder on one worker, which builds what they share once."""

    def folder(item: pytest.Item) -> str:
        inner = item.path.relative_to(Path(__file__).parent)
        return inner.parts[0]

    order = {name: place for place, name in enumerate(LONGEST_FIRST)}
    items.sort(key=lambda item: order.get(folder(item), len(order)))
    for item in items:
        item.add_marker(pytest.mark.xdist_group(folder(item)))


@pytest.fixture(scope="session")
def project_root() -> Path:
    """The root folder of the checkout."""
    return Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def load_module() -> Callable[[Path], ModuleType]:
    """A script beside the package, as a module."""

    def load(path: Path) -> ModuleType:
        spec = spec_from_file_location(path.stem, path)
        assert spec is not None
        assert spec.loader is not None
        module = module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load


@pytest.fixture(scope="session")
def smoke_scenario(project_root: Path) -> Scenario:
    """The small scenario: 4 URLLC and 4 eMBB users, 10 PRBs."""
    from hiersched.scenario import load_scenario

    config = project_root / "src/hiersched/config"
    return load_scenario(config / "scenarios" / "smoke.yaml", defaults=config / "defaults.yaml")


@pytest.fixture(scope="session")
def nominal_gains() -> Callable[[Scenario], Gains]:
    """The nominal gain at every delay, for a scenario's sampling interval and weight."""
    from hiersched.simulator.loop_gains import Gains, plant_of

    made: dict[object, Gains] = {}

    def gains(scenario: Scenario) -> Gains:
        if scenario.control not in made:
            K = plant_of(scenario).nominal_gain
            network = np.repeat(K[None], scenario.max_delay_steps + 1, axis=0)
            made[scenario.control] = Gains.memoryless(network)
        return made[scenario.control]

    return gains


@pytest.fixture(scope="session")
def scenario(smoke_scenario: Scenario) -> Scenario:
    """Three URLLC and two eMBB users, episodes of six slots: for environments and learners."""
    smoke = smoke_scenario
    return replace(
        smoke,
        users=replace(smoke.users, num_urllc=3, num_embb=2),
        radio=replace(smoke.radio, num_prb=8),
        traffic=replace(smoke.traffic, urllc_offered_mbps=(12.0, 16.0, 22.0), load=1.1),
        learning=replace(smoke.learning, slots_per_episode=6),
    )


@pytest.fixture(scope="session")
def gains(scenario: Scenario, nominal_gains: Callable[[Scenario], Gains]) -> Gains:
    """The nominal gain at every delay of `scenario`."""
    return nominal_gains(scenario)


def per_user(value, num_users):
    return np.broadcast_to(np.asarray(value, np.float64), (num_users,)).copy()


@pytest.fixture(scope="session")
def make_terms():
    """Terms of the Lagrangian for U users; no arrivals, no multiplier unless given."""

    def make(num_users, **given):
        arrays = {
            "backlog_packets": 0.0,
            "offered_mbps": 0.0,
            "rate_sensitivity": 0.0,
            "arrival_packets_per_mbps": 1.0,
            "service_offset_mbps": 0.0,
            "multiplier": 0.0,
            "drift_weight": 1.0,
        }
        scalars = {
            "service_packets_per_mbps": 1.0,
            "penalty_weight": 0.0,
            "epsilon": 0.01,
            "delay_exponent_per_mbps": 0.16,
            "violation_share": 0.05,
        }
        from hiersched.allocation.objective import UserTerms

        assert given.keys() <= arrays.keys() | scalars.keys()
        filled = {name: per_user(given.get(name, arrays[name]), num_users) for name in arrays}
        return UserTerms(**filled, **{name: given.get(name, scalars[name]) for name in scalars})

    return make


@pytest.fixture(scope="session")
def decide_by_hand(smoke_scenario, nominal_gains):
    """Let a rule decide one handmade slot; returns the simulator after it, and the owners (K,)."""
    from hiersched.core.pointer import Pointer
    from hiersched.core.randomness import world_keys
    from hiersched.policies.registry import RULES
    from hiersched.simulator import Simulator
    from hiersched.simulator.setup import TASK_STATE

    smoke, made = smoke_scenario, {}

    def of_size(num_urllc, num_users, num_prb):
        size = num_urllc, num_users, num_prb
        if size not in made:
            scenario = replace(
                smoke,
                users=replace(smoke.users, num_urllc=num_urllc, num_embb=num_users - num_urllc),
                radio=replace(smoke.radio, num_prb=num_prb),
                traffic=replace(smoke.traffic, urllc_offered_mbps=10.0, embb_offered_mbps=10.0),
            )
            made[size] = Simulator(scenario, nominal_gains(scenario), world_keys("hand", 1, 1), 1)
        return made[size]

    def put(pointer, **values):
        """Put numbers in place of those of a NamedTuple that the kernels see by pointer."""
        assert all(np.isscalar(getattr(pointer.value, name)) for name in values)
        pointer.words[:] = Pointer(pointer.value._replace(**values)).words

    def decide(
        name,
        rate,
        *,
        slot=0,
        weight=1.0,
        hol_delay_s=0.0,
        average_rate_mbps=10.0,
        last_rate_mbps=0.0,
        deadline_s=0.02,
        late_share=0.05,
        num_urllc=None,
        need="none",
        backlog_packets=0.0,
        offered_mbps=0.0,
        rate_sensitivity=0.0,
        arrival_packets_per_mbps=1.0,
        service_offset_mbps=0.0,
        multiplier=0.0,
        service_packets_per_mbps=1.0,
        penalty_weight=0.0,
        epsilon=0.01,
        delay_exponent_per_mbps=0.16,
        violation_share=0.05,
        mean_due_packets=1.0,
        keys=None,
        **task,
    ):
        rate = np.asarray(rate, np.float32)
        num_users, num_prb = rate.shape
        num_urllc = num_users if num_urllc is None else num_urllc
        simulator = of_size(num_urllc, num_users, num_prb)
        coefficient_mbps = 2.0  # a power of two: halves of the offsets are exact
        of_urllc = {}
        for key, value in (("multiplier", multiplier), ("offset", service_offset_mbps)):
            of_urllc[key] = per_user(value, num_users)
            assert np.ndim(value) == 0 or not of_urllc[key][num_urllc:].any()
        state, constants = simulator.state, simulator.constants
        state.slot[:] = slot
        state.reported_rate_mbps[0] = rate
        state.backlog_packets[0] = backlog_packets
        state.hol_delay_s[0] = hol_delay_s
        state.average_rate_mbps[0] = average_rate_mbps
        state.rate_mbps[0] = last_rate_mbps
        state.dexterity_index[0] = of_urllc["offset"][:num_urllc] / coefficient_mbps
        constants.deadline_s[:] = deadline_s
        constants.late_share[:] = late_share
        constants.mean_due_packets[:] = mean_due_packets
        assert task.keys() <= set(TASK_STATE)
        for field in TASK_STATE:
            getattr(state, field)[0] = task.get(field, 0.0)
        constants.offered_mbps[:] = offered_mbps
        constants.rate_sensitivity[:] = rate_sensitivity
        constants.arrival_packets_per_mbps[:] = arrival_packets_per_mbps
        terms = {
            "service_packets_per_mbps": service_packets_per_mbps,
            "penalty_weight": penalty_weight,
            "epsilon": epsilon,
            "delay_exponent_per_mbps": delay_exponent_per_mbps,
            "violation_share": violation_share,
        }
        put(
            simulator._constants,
            **terms,
            slot_s=0.01,
            service_coefficient_mbps=coefficient_mbps,
        )
        # What no rule writes is no user's.
        simulator._one.value.fields.prb_owner[:] = 10**6
        state.need_mbps[:] = state.index_weight[:] = state.drift_weight[:] = np.nan
        of_rule = {"need": need} if hasattr(RULES[name], "need") else {}
        owner = simulator.decide(
            RULES[name](**of_rule, **(keys or {})),
            of_urllc["multiplier"][None, :num_urllc],
            weights=per_user(weight, num_users)[None],
        )
        return simulator, owner[0]

    return decide


@pytest.fixture(scope="session")
def schedule(decide_by_hand):
    """Run one scheduler for one slot; returns the owner of each PRB as a list."""

    def run(name, rate, **values):
        return decide_by_hand(name, rate, **values)[1].tolist()

    return run


@pytest.fixture(scope="session")
def torch_weights():
    """Weights (E, U) that torch forms of features (E, U, F) for a trained policy."""

    def weights(policy, features):
        import torch

        from hiersched.env import action_weights
        from hiersched.learning.networks import NETWORKS, Slices

        num_urllc = len(policy.multipliers)
        slices = Slices(num_urllc, features.shape[1] - num_urllc)
        network = NETWORKS[policy.network](slices, features.shape[2], policy.hidden)
        with torch.no_grad():
            inputs = network.inputs(torch.from_numpy(features).unsqueeze(0))
            outputs = network.actor_outputs(torch.from_numpy(policy.parameters), inputs)
            actions = network.raw_actions(outputs, 1).tanh()[0].numpy()
        return action_weights(actions, policy.weight_exponent)

    return weights


@pytest.fixture
def write_plugin(monkeypatch):
    """Write the file of a plug-in; what it registers is gone after the test."""
    from hiersched.core import registry

    monkeypatch.setattr(sys, "path", list(sys.path))
    written = []

    def write(path, text):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        written.append(path)
        return path

    yield write
    for path in written:
        if sys.modules.pop(path.stem, None):
            registry._forget(path.resolve())


@pytest.fixture
def other_table(monkeypatch: pytest.MonkeyPatch) -> Callable[..., AbstractContextManager[None]]:
    """Within its context logs are written with another table of fields, as by another version."""
    from hiersched.core.fields import FIELDS, Field
    from hiersched.log import schema, writer

    @contextmanager
    def other(change: Callable[[list[Field]], list[Field]], version: int = 7) -> Iterator[None]:
        with monkeypatch.context() as patch:
            patch.setattr(schema, "TOPICS", schema.topics_of(change(list(FIELDS))))
            patch.setattr(writer, "SCHEMA_VERSION", version)
            patch.setattr(writer, "LIBRARY", f"hiersched-log/{version}")
            yield

    return other


@pytest.fixture(scope="session")
def browser(
    project_root: Path, load_module: Callable[[Path], ModuleType]
) -> Callable[[], AbstractContextManager[Any]]:
    """Start a Chromium without a window; see `browser.py` beside this file."""
    module = load_module(project_root / "tests/browser.py")
    program = module.find_chromium()
    if program is None:
        pytest.skip("needs Chromium")
    return lambda: module.browser(program)
