"""Experiments of a study: which points, policies, seeds and gains they have."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hiersched.experiments import files
from hiersched.experiments.gains import design_of, designs, experiment_designs
from hiersched.experiments.points import (
    ForcedDelays,
    Point,
    baseline_method,
    cell_scenario,
    experiments,
    groups,
    is_crossed,
    learner_scenario,
    robots_alone,
    trained_learners,
    value_text,
)
from hiersched.experiments.worlds import seed_worlds
from hiersched.scenario import (
    Scenario,
    ScenarioError,
    load_resolved,
    scenario_to_dict,
    scenario_to_yaml,
)
from hiersched.scenario.schema import Control, GainMethod

Load = Callable[[str], Scenario]


def at(data: Any, key: str) -> Any:
    for part in key.split("."):
        data = data[part]
    return data


def put(data: dict[str, Any], key: str, value: Any) -> None:
    *parents, name = key.split(".")
    (at(data, ".".join(parents)) if parents else data)[name] = value


def values_of(scenario: Scenario, experiment: str) -> list[str]:
    return [point.value for point in experiments(scenario)[experiment].points]


# Sweeps.


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.005, "0.005"),
        (1.0, "1"),
        (0.1 + 0.2, "0.3"),
        (20000, "20000"),
        (1e-7, "1e-07"),
        ("zigzag", "zigzag"),
        ("a/b: c", "a-b--c"),
        (True, "true"),
        (None, "null"),
        ([10.0, 12.5], "10-12.5"),
        ({"model": "macro", "shadowing_db": 0.0}, "macro-shadowing_db-0"),
        ({"model": "none"}, "none"),
    ],
)
def test_value_text(value: Any, text: str) -> None:
    assert value_text(value) == text


def test_a_point_of_a_sweep_is_the_scenario_but_for_what_it_varies(tiny: Scenario) -> None:
    axes = tiny.sweeps.axes
    assert list(axes) == [
        *("rayleigh_scale", "sampling_s", "reference"),
        *("load", "load_ratio", "service_coefficient_mbps"),
    ]
    for name, axis in axes.items():
        swept = experiments(tiny)[name]
        assert (swept.stage, swept.axis, swept.seeds) == ("sweep", name, (21,))
        for point in swept.points:
            expected = scenario_to_dict(tiny)
            assert point.values.keys() == axis.vary.keys()
            for key, value in point.values.items():
                assert value in axis.vary[key]
                put(expected, key, value)
            assert scenario_to_dict(point.scenario) == expected


ANY_KEY = {
    "traffic.packet_bits": ("[1.0e+4, 2.0e+4]", ["10000", "20000"]),
    "users.num_embb": ("[1, 2]", ["1", "2"]),
    "traffic.urllc_offered_mbps": ("[[20.0, 30.0], 7.5]", ["20-30", "7.5"]),
    "traffic.load_ratio": ("[null, 1.5]", ["null", "1.5"]),
    "robot.reference_repeat": ("[false, true]", ["false", "true"]),
    "radio.path_loss": (
        "[{model: none}, {model: macro, shadowing_db: 0.0}]",
        ["none", "macro-shadowing_db-0"],
    ),
    "radio.path_loss.model": ("[none, macro]", ["none", "macro"]),
}


@pytest.mark.parametrize("key", ANY_KEY)
@pytest.mark.parametrize("form", ["long", "short"])
def test_any_key_can_be_swept(tiny_with: Load, key: str, form: str) -> None:
    """No code knows these as axes."""
    values, names = ANY_KEY[key]
    axis = f"mine: {{vary: {{{key}: {values}}}}}" if form == "long" else f"{key}: {values}"
    scenario = tiny_with(f"sweeps: {{axes: {{{axis}}}}}")
    name = "mine" if form == "long" else key
    swept = experiments(scenario)[name]
    assert [point.value for point in swept.points] == names
    assert swept.policies == ("ddpg", "pf")
    found = [at(scenario_to_dict(point.scenario), key) for point in swept.points]
    assert found[0] != found[1]
    for value, point in zip(found, swept.points, strict=True):
        given = point.values[key]
        wanted = given.items() if isinstance(given, dict) else {"": given}.items()
        assert wanted <= (value if isinstance(given, dict) else {"": value}).items()


PLUGIN = """
from dataclasses import dataclass
from typing import Literal
import numpy as np
from hiersched.models.model import PATH_LOSS, PathLoss

@PATH_LOSS.model
@dataclass(frozen=True, kw_only=True)
class PowerLaw(PathLoss):
    model: Literal["steep_power_law"]
    exponent: float = 3.0

    def gain(self, key, num_users):
        return np.full(num_users, 10.0 ** -self.exponent)

    def least_gain_db(self):
        return -10.0 * self.exponent

def tail_risk(view, level):
    return np.ones_like(view.backlog_packets)
"""


def test_keys_of_plugins_can_be_swept_from_any_folder(
    tiny_with: Load, tmp_path: Path, write_plugin: Callable[[Path, str], Path]
) -> None:
    """The plug-in lies beside the scenario, the working directory is another one."""
    write_plugin(tmp_path / "swept_plugin.py", PLUGIN)
    scenario = tiny_with(
        "plugins: [swept_plugin.py]\n"
        "radio: {path_loss: {model: steep_power_law}}\n"
        'policies: {mine: {import: "swept_plugin:tail_risk", parameters: {level: 0.9}}}\n'
        "sweeps: {policies: [mine], axes: {radio.path_loss.exponent: [2.0, 4.0],"
        " level: {vary: {policies.mine.parameters.level: [0.5, 0.99]}}}}"
    )
    exponents = experiments(scenario)["radio.path_loss.exponent"].points
    assert [point.scenario.radio.path_loss.exponent for point in exponents] == [2.0, 4.0]
    levels = experiments(scenario)["level"].points
    assert [p.scenario.policies["mine"].parameters["level"] for p in levels] == [0.5, 0.99]


def test_an_axis_of_two_keys_has_every_combination(tiny_with: Load) -> None:
    scenario = tiny_with(
        "sweeps: {axes: {both: {vary: "
        "{traffic.load: [0.8, 0.9], users.num_embb: [1, 2, 3], robot.speed_mps: [0.5]}}}}"
    )
    points = experiments(scenario)["both"].points
    assert [(p.scenario.traffic.load, p.scenario.users.num_embb) for p in points] == [
        *((0.8, 1), (0.8, 2), (0.8, 3)),
        *((0.9, 1), (0.9, 2), (0.9, 3)),
    ]
    assert [p.value for p in points[:2]] == ["0.8_1_0.5", "0.8_2_0.5"]
    assert values_of(scenario, "service_coefficient_mbps") == ["2_0.02", "2_0.04"]


def test_policies_along_an_axis(tiny_with: Load) -> None:
    """All that are evaluated but the slow one, the pair of the claims, or those of a list."""
    scenario = tiny_with(
        "evaluate: {policies: [ddpg, edf, exact]}\n"
        "sweeps: {axes: {packets: {vary: {traffic.packet_bits: [2.0e+4]}, policies: [edf]}}}"
    )
    found = {name: e.policies for name, e in experiments(scenario).items()}
    assert found["load"] == ("ddpg", "pf", "edf")
    assert found["reference"] == ("ddpg", "pf")
    assert found["load_ratio"] == ("ddpg", "pf")
    assert found["packets"] == ("edf",)
    more = tiny_with("sweeps: {policies: [max_weight, pf]}")
    assert experiments(more)["reference"].policies == ("max_weight", "pf")
    assert experiments(more)["load_ratio"].policies == ("pf",)


def test_an_axis_without_policies_is_no_experiment(tiny_with: Load) -> None:
    """`own` along an axis of a study that runs neither its learner nor PF there."""
    scenario = tiny_with("sweeps: {policies: [edf]}")
    assert "load_ratio" not in experiments(scenario)
    assert "reference" in experiments(scenario)


def test_all_faults_of_all_points_are_listed(tiny_with: Load) -> None:
    """0.03 s is a multiple of the substep, as the scenario asks, but does not divide a window."""
    scenario = tiny_with(
        "sweeps: {axes: {sampling_s: {vary: {control.sampling_s: [0.02, 0.03]}},"
        " load: {vary: {traffic.load: [-1.0]}}}}\n"
        "generalise: {cells: [[4, 2, 6], [600, 1, 601]]}"
    )
    with pytest.raises(ScenarioError) as caught:
        experiments(scenario)
    lines = str(caught.value).splitlines()
    starts = [
        "sweeps.axes.sampling_s.vary: with control.sampling_s = 0.03: robot.window_s = 1.0: must",
        "sweeps.axes.load.vary: with traffic.load = -1.0: traffic.load = -1.0: must be greater",
    ]
    assert [line for line, start in zip(lines, starts, strict=False) if line.startswith(start)] == (
        lines[:2]
    )


# Gains.


def test_designs_are_named_after_what_differs(tiny: Scenario) -> None:
    assert list(designs(tiny)) == [
        "schedule",
        "schedule_sampling_s_0.04",
        "schedule_loop_split_method_razumikhin",
        "schedule_method_predictor",
        "schedule_weight_900",
    ]
    for name, own in designs(tiny).items():
        assert design_of(tiny, own) == name
    (grid,) = (e for e in experiments(tiny).values() if e.name == "gain_grid")
    assert experiment_designs(tiny, grid) == ["schedule", "schedule_weight_900"]
    assert [design_of(tiny, p.scenario) for p in grid.points] == [
        *("schedule", "schedule", "schedule_weight_900", "schedule_weight_900")
    ]
    both = experiments(tiny)["service_coefficient_mbps"]
    assert experiment_designs(tiny, both) == ["schedule", "schedule_sampling_s_0.04"]


def test_a_swept_key_that_gains_follow_has_designs_of_its_own(tiny_with: Load) -> None:
    scenario = tiny_with(
        "sweeps: {axes: {robot.speed_mps: [0.5, 1.0], traffic.packet_bits: [2.0e+4]}}"
    )
    assert scenario.robot.speed_mps == 1.0
    assert "schedule_speed_mps_0.5" in designs(scenario)
    swept = experiments(scenario)
    assert experiment_designs(scenario, swept["robot.speed_mps"]) == [
        *("schedule_speed_mps_0.5", "schedule")
    ]
    assert experiment_designs(scenario, swept["traffic.packet_bits"]) == ["schedule"]


def test_a_design_that_differs_in_much_has_a_short_name(tiny_with: Load) -> None:
    """Matrices as names of files would be too long."""
    matrix = [[[1.0, 0.02], [0.0, 1.0]], [[1.0, 0.02], [0.0, 0.123456789]]]
    scenario = tiny_with(
        "plant: {model: linear, A: [[1.0, 0.02], [0.0, 0.9]], B: [[0.0002], [0.02]],"
        " Q: [[1.0, 0.0], [0.0, 0.1]], R: [[0.1]], process_noise: [0.0, 0.01],"
        " measurement_noise: [0.001, 0.001], error_states: [0]}\n"
        "gain_study: {methods: [], sampling_s: []}\n"
        f"sweeps: {{axes: {{sampling_s: null, service_coefficient_mbps: null, abc: {{vary: "
        f"{{plant.A: {matrix}, plant.B: [[[0.0002], [0.0212345678]]],"
        f" plant.Q: [[[1.0, 0.0], [0.0, 0.1123456]]]}}}}}}}}"
    )
    names = list(designs(scenario))
    assert len(names) == 3
    assert max(map(len, names)) < 80
    for point in experiments(scenario)["abc"].points:
        assert design_of(scenario, point.scenario) in names[1:]


def test_points_of_the_gain_study(tiny: Scenario) -> None:
    found = experiments(tiny)
    assert [name for name in found if name.startswith("gain_")] == [
        *("gain_study", "gain_grid", "gain_sampling_s", "gain_noise")
    ]
    assert values_of(tiny, "gain_study") == ["krasovskii", "razumikhin", "predictor"]
    grid = found["gain_grid"].points
    assert [p.value for p in grid] == ["q700_0.02", "q700_0.04", "q900_0.02", "q900_0.04"]
    assert grid[2].delays == ForcedDelays(
        windows=(2,), violation_s=(0.02, 0.02), calm_s=tiny.gain_study.calm_delay_s
    )
    assert grid[2].scenario.control == replace(tiny.control, weight=900.0)
    assert (grid[2].scenario.users.num_urllc, grid[2].scenario.radio.num_prb) == (2, 3)
    (noise,) = found["gain_noise"].points
    assert noise.value == "0_0.01"
    robot = replace(tiny.robot, noise_position_m=0.0, noise_heading_rad=0.01)
    assert noise.scenario == robots_alone(replace(tiny, robot=robot), 2, "")
    assert values_of(tiny, "gain_sampling_s") == ["0.02", "0.04"]
    for name in ("gain_study", "gain_grid"):
        assert found[name].forced
        assert (found[name].policies, found[name].seeds) == (("nominal", "adjusted"), (31, 32))
    assert not found["evaluate"].forced


def test_methods_on_one_plant_share_the_runs_with_the_nominal_gain(tiny: Scenario) -> None:
    policies = {p.value: p.policies for p in experiments(tiny)["gain_study"].points}
    both = ("nominal", "adjusted")
    assert policies == {"krasovskii": both, "razumikhin": both, "predictor": ("adjusted",)}
    assert baseline_method(tiny, "predictor") == "krasovskii"
    assert baseline_method(tiny, "razumikhin") == "razumikhin"


def test_predictors_are_not_held_and_what_replaces_one_is(tiny: Scenario) -> None:
    def hold(control: Control, method: GainMethod) -> int:
        study = replace(tiny.gain_study, methods=(method,))
        points = experiments(replace(tiny, control=control, gain_study=study))["gain_study"].points
        return points[0].scenario.control.hold_samples

    own, predictor = tiny.control, replace(tiny.control, method="predictor", hold_samples=0)
    assert hold(replace(own, hold_samples=3), "predictor") == 0
    assert hold(replace(own, hold_samples=3), "razumikhin") == 3
    assert hold(replace(own, hold_samples=0), "razumikhin") == 0
    assert hold(predictor, "predictor") == 0
    assert hold(predictor, "krasovskii") == 5


def test_forced_delays_are_long_in_the_violation_windows(tiny: Scenario) -> None:
    (point, *_) = experiments(tiny)["gain_study"].points
    assert point.delays is not None
    keys = seed_worlds("gain_study", (31, 32))
    delays = point.delays.draw(point.scenario, keys, 300)
    assert delays.shape == (2, 300, 3)
    violation, calm = delays[:, 100:200], np.delete(delays, np.s_[100:200], axis=1)
    assert 0.08 <= violation.min() < 0.081 < 0.119 < violation.max() <= 0.12
    assert 0.005 <= calm.min() < 0.0052 < 0.0198 < calm.max() <= 0.02
    assert violation.mean() == pytest.approx(0.1, abs=2e-3)  # four standard errors
    assert np.array_equal(delays[1:], point.delays.draw(point.scenario, keys[1:], 300))
    assert len(np.unique(delays)) == delays.size
    assert ForcedDelays.from_json(point.delays.to_json()) == point.delays


# Cells.


def test_a_cell_keeps_the_spread_of_the_loads_and_the_width_of_a_prb(tiny: Scenario) -> None:
    traffic = replace(tiny.traffic, urllc_offered_mbps=(10.0, 30.0), embb_offered_mbps=22.0)
    base = replace(tiny, traffic=traffic)
    cells = [cell_scenario(base, cell) for cell in ((1, 3, 5), (2, 2, 5), (3, 1, 10), (4, 4, 10))]
    offered = [cell.traffic.urllc_offered_mbps for cell in cells]
    assert offered == [(20.0,), (10.0, 30.0), (10.0, 20.0, 30.0), (10.0, 10.0, 30.0, 30.0)]
    for cell in cells:
        assert cell.radio.bandwidth_hz / cell.radio.num_prb == pytest.approx(4e5)
        assert cell.traffic.embb_offered_mbps == 22.0
    with pytest.raises(ScenarioError, match=r"generalise\.cells = \[4, 2, 5\]"):
        cell_scenario(base, (4, 2, 5))


def test_cells_are_points_by_their_sizes(tiny: Scenario) -> None:
    cells = experiments(tiny)["generalise"]
    assert [point.value for point in cells.points] == ["u1_e3_k6", "u3_e4_k9"]
    assert (cells.stage, cells.axis) == ("generalise", "cell")
    assert cells.points[1].scenario == cell_scenario(tiny, (3, 4, 9))


# Policies and learners.


def test_groups(tiny: Scenario) -> None:
    two = replace(tiny, learners={"flat": replace(tiny.learning, network="mlp")})
    evaluation = replace(experiments(two)["evaluate"], policies=("flat", "pf", "ddpg", "edf"))
    assert groups(two, evaluation) == {
        "classical": ("pf", "edf"),
        "flat": ("flat",),
        "ddpg": ("ddpg",),
    }
    assert next(iter(groups(two, evaluation))) == "classical"
    assert groups(two, experiments(two)["gain_grid"]) == {"gains": ("nominal", "adjusted")}


def test_learners_that_train_are_those_whose_policies_run_and_their_controls(
    tiny: Scenario,
) -> None:
    """A control learns nothing, and is there for a learner of its algorithm and start."""
    own, a2c = tiny.learning, replace(tiny.learning, algorithm="a2c")
    learners = {
        "a2c": a2c,
        "frozen": replace(own, frozen=True),
        "frozen_a2c": replace(a2c, frozen=True),
        "unused": replace(own, actor_lr=1e-5),
    }
    assert trained_learners(replace(tiny, learners=learners)) == ("ddpg", "frozen")
    named = replace(tiny.evaluate, policies=("ddpg", "a2c"))
    both = replace(tiny, learners=learners, evaluate=named)
    assert trained_learners(both) == ("ddpg", "a2c", "frozen", "frozen_a2c")


def test_policies_of_one_training_seed_are_all_logged(tiny: Scenario) -> None:
    one = replace(tiny, learning=replace(tiny.learning, seeds=(1,)))
    assert is_crossed(tiny, "ddpg")
    assert not is_crossed(one, "ddpg")
    assert not is_crossed(tiny, "pf")
    crossed = [files.group_files(s, experiments(s)["reference"], "ddpg") for s in (tiny, one)]
    assert [len(names) for names in crossed] == [2, 1]
    assert crossed[1] == ["runs/reference/arc/ddpg/seed21.mcap"]


def test_no_two_files_share_a_path(tiny: Scenario) -> None:
    names = [
        *files.learner_logs(tiny, "ddpg"),
        *files.policy_files(tiny, "ddpg"),
        *map(files.gain_file, designs(tiny)),
        *(
            name
            for experiment in experiments(tiny).values()
            for group in groups(tiny, experiment)
            for name in files.group_files(tiny, experiment, group)
        ),
    ]
    gain_runs = 5 * 2 + (4 + 2 + 1) * 2 * 2
    evaluation = 3 * 3 + 1
    sweeps = 2 * (2 + 1) + 2 * (2 + 1) + (2 + 1) + (3 + 1) + (2 + 1) + 2 * (2 + 1)
    cells = 2 * (3 * 2 + 1)
    assert len(names) == 4 + 2 + 5 + gain_runs + evaluation + sweeps + cells
    assert len(set(names)) == len(names)


def test_a_learner_trains_in_a_scenario_of_its_own(tiny: Scenario) -> None:
    """Nothing of the others is left in it, and it can be read back from a log."""
    flat = replace(tiny.learning, network="mlp", seeds=(7, 8))
    slow = replace(tiny.learning, actor_lr=1e-5)
    named = replace(tiny.evaluate, policies=("ddpg", "flat", "pf", "slow"))
    axes = dict(tiny.sweeps.axes)
    axes["reference"] = replace(axes["reference"], policies=("flat", "edf"))
    two = replace(
        tiny,
        learners={"flat": flat, "slow": slow},
        evaluate=named,
        sweeps=replace(tiny.sweeps, axes=axes),
    )
    own = learner_scenario(two, "flat")
    assert (own.learning, own.learners) == (flat, {})
    assert own.evaluate.policies == ("ddpg", "pf")
    assert own.sweeps.axes["reference"].policies == ("ddpg", "edf")
    faster = replace(two, learners={"flat": flat, "slow": tiny.learning})
    assert learner_scenario(faster, "flat") == own
    assert load_resolved(scenario_to_yaml(own), Path("log"))[0] == own
    logs = ["train/flat/seed7.mcap", "train/flat/seed8.mcap"]
    assert files.learner_logs(two, "flat")[:2] == logs
    with pytest.raises(ValueError, match="'fast': must be one of ddpg, flat, slow"):
        learner_scenario(two, "fast")


# Parts that a study can do without.


def test_a_study_has_what_its_scenario_names(tiny_with: Load) -> None:
    bare = tiny_with(
        "evaluate: {policies: [pf, edf]}\n"
        "sweeps: {policies: [pf], axes: {rayleigh_scale: null, sampling_s: null, reference: null,"
        " load: null, load_ratio: null, service_coefficient_mbps: null}}\n"
        "generalise: {cells: []}\ngain_study: {methods: []}\nbound: {slots_per_log: 0}\n"
    )
    assert list(experiments(bare)) == ["evaluate"]
    assert trained_learners(bare) == ()
    assert list(designs(bare)) == ["schedule"]
    (point,) = experiments(bare)["evaluate"].points
    assert point == Point(value="", scenario=bare)
    part = tiny_with("gain_study: {weight: [], sampling_s: []}")
    assert {"gain_study", "gain_noise"} <= experiments(part).keys()
    assert not {"gain_grid", "gain_sampling_s"} & experiments(part).keys()


def test_cells_of_other_sizes_repeat_the_row_of_robots(tiny_with: Load) -> None:
    scenario = tiny_with(
        "robot_kinds: {heavy: {robots: [1], values: {robot.actuator_lag_s: 0.2}},"
        " slippy: {robots: [0], values: {robot.slip_speed_mps: 0.2}}}"
    )
    assert robots_alone(scenario, 5, "test").kind_of_robot == (2, 1, 2, 1, 2)
    fewer = cell_scenario(scenario, (1, 3, 6))
    assert fewer.kind_of_robot == (1,)
    assert list(fewer.robot_kinds) == ["slippy"]
    found, _, _ = load_resolved(scenario_to_yaml(fewer), Path("scenario.yaml"))
    assert found == fewer
