"""Every faulty scenario: one error with file, key, value and what is allowed."""

from __future__ import annotations

import pytest

from hiersched.scenario import ScenarioError, find_scenario, load_scenario


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        # A misspelt key, in a section and as a section.
        ("radio: {num_prbs: 25}", ["radio.num_prbs = 25", "unknown key", "num_prb,"]),
        ("radios: {num_prb: 25}", ["radios = {'num_prb': 25}", "unknown key", "users, radio"]),
        ("num_prb: 25", ["num_prb = 25", "unknown key", "users, radio"]),
        # Out of range.
        ("radio: {slot_s: 0.0}", ["radio.slot_s = 0.0", "must be greater than 0"]),
        ("radio: {num_prb: 5000}", ["radio.num_prb = 5000", "less than or equal to 512"]),
        ("traffic: {reliability: 95}", ["traffic.reliability = 95", "must be less than 1"]),
        (
            "traffic: {arrivals: {rate_sensitivity: -0.1}}",
            ["arrivals.rate_sensitivity = -0.1", "equal to 0"],
        ),
        ("learning: {seeds: [1, -2]}", ["learning.seeds.1 = -2", "greater than or equal to 0"]),
        ("learning: {seeds: []}", ["learning.seeds = []", "at least 1"]),
        ("radio: {slot_s: .inf}", ["radio.slot_s", "inf"]),
        ("radio: {slot_s: .nan}", ["radio.slot_s", "nan"]),
        # Text where a number belongs, a number where text belongs, neither.
        ("radio: {num_prb: many}", ["radio.num_prb = 'many'", "valid integer"]),
        ("radio: {num_prb: '25'}", ["radio.num_prb = '25'", "valid integer"]),
        ("radio: {num_prb: 25.5}", ["radio.num_prb = 25.5", "integer"]),
        ("radio: {slot_s: yes}", ["radio.slot_s = True", "valid number"]),
        ("radio: {slot_s: 1e-2}", ["radio.slot_s = '1e-2'", "write 1.0e-3"]),
        ("radio: {slot_s: [0.01]}", ["radio.slot_s = [0.01]", "valid number"]),
        ("radio: 25", ["radio = 25"]),
        ("name: 3", ["name = 3", "valid string"]),
        ("radio: {slot_s: 2024-01-01}", ["neither number, text, list nor mapping"]),
        # Not one of the choices.
        (
            "control: {loop: wireless}",
            ["control.loop = 'wireless'", "'network', 'split' or 'local'"],
        ),
        ("robot: {reference: circle}", ["robot.reference = 'circle'", "'figure_eight'"]),
        (
            "evaluate: {policies: [pf, best]}",
            ["evaluate.policies = ['pf', 'best']: best is no policy", "allowed: ddpg, pf"],
        ),
        ("name: A B", ["name = 'A B'", "pattern"]),
        # Keys that do not fit each other.
        (
            "learning: {algorithm: a2c}",
            ["evaluate.policies = ['ddpg'", "ddpg is not trained where learning.algorithm = a2c"],
        ),
        # Learners.
        ("learners: {flat: {netwrk: mlp}}", ["learners.flat.netwrk = 'mlp': unknown", "network"]),
        ("learners: {flat: {discount: 1.5}}", ["learners.flat.discount = 1.5", "less than 1"]),
        ("learners: {flat: mlp}", ["learners.flat = 'mlp'"]),
        ("learners: [flat]", ["learners = ['flat']"]),
        ("learners: {Flat: {}}", ["learners.Flat", "pattern"]),
        ("learners: {pf: {}}", ["learners.pf: the name of a scheduler"]),
        ("learners: {ddpg: {}}", ["learners.ddpg: the name of learning.algorithm"]),
        (
            "learners: {flat: {episodes: 7}}",
            ["learners.flat.episodes = 7", "multiple of learners.flat.num_envs = 16"],
        ),
        (
            "learners: {flat: {reward_scale: 7.0}}",
            ["learners.flat.reward_scale = 7.0", "must be learning.reward_scale = 100.0"],
        ),
        ("learners: {flat: {seeds: [1, 1]}}", ["learners.flat.seeds = [1, 1]: every seed once"]),
        (
            "learning: {start: drift_plus_penalty}",
            ["learning.start = drift_plus_penalty: must be pf or max_weight", "algorithm = ddpg"],
        ),
        (
            "users: {num_urllc: 20}\ntraffic: {urllc_offered_mbps: 10.0}",
            ["users.num_urllc + users.num_embb = 30", "at most radio.num_prb = 25"],
        ),
        (
            "users: {num_urllc: 9}",
            [
                "traffic.urllc_offered_mbps",
                "10 numbers",
                "users.num_urllc = 9: must be one number, or 9",
            ],
        ),
        (
            "radio: {path_loss: {model: macro, min_distance_m: 500.0}}",
            ["radio.path_loss.min_distance_m = 500.0", "radio.path_loss.cell_radius_m = 400"],
        ),
        (
            "radio: {tx_power_dbm: -300.0}",
            ["tx_power_dbm = -300.0", "from -190 dB", "within -80 dB"],
        ),
        ("radio: {noise_dbm: -400}", ["radio.noise_dbm = -400", "to 420 dB", "to 300 dB"]),
        (
            "radio: {path_loss: {model: macro, cell_radius_m: 80000.0}}",
            ["to 130 dB", "path loss and shadowing included", "within -80 dB"],
        ),
        ("radio: {slot_s: 0.009}", ["radio.slot_s = 0.009", "robot.substep_s = 0.0025"]),
        ("control: {sampling_s: 0.001}", ["control.sampling_s = 0.001", "multiple of"]),
        ("robot: {window_s: 0.015}", ["robot.window_s = 0.015", "radio.slot_s = 0.01"]),
        ("control: {method: razumikhin}", ["control.method = 'razumikhin'", "loop = 'split'"]),
        ("control: {hold_samples: -1}", ["control.hold_samples = -1", "equal to 0"]),
        (
            "control: {method: predictor, hold_samples: 4}",
            ["control.hold_samples = 4: must be 0 with control.method = 'predictor'"],
        ),
        *(
            (
                f"control: {{method: {method}, loop: split}}",
                [f"control.method = '{method}'", "loop = 'network'"],
            )
            for method in ("predictor", "latency_compensated", "h2", "lqg")
        ),
        (
            "control: {method: lqg, hold_samples: 4}",
            ["control.hold_samples = 4: must be 0 with control.method = 'lqg'"],
        ),
        ("control: {link: playout}", ["control.link = 'playout': needs control.method = 'lqg'"]),
        (
            "control: {method: lqg, link: playout, delay: age}\nrobot: {superseding: batch}",
            ["robot.superseding = 'batch': must be none with control.link = 'playout'"],
        ),
        (
            "control: {method: lqg}\nrobot: {superseding: batch}",
            ["control.delay = 'sojourn': must be 'age' with control.method = 'lqg'"],
        ),
        (
            "gain_study: {cells: {far: {delay_s: 0.1, values: {radio.num_prb: 30}}}}",
            ["gain_study.cells.far.values.radio.num_prb: must be a key of robot, control"],
        ),
        (
            "gain_study: {cells: {far: {delay_s: 0.1, values: {control.method: h2}}}}",
            ["gain_study.cells.far.values.control.method", "none of control.method"],
        ),
        (
            "gain_study: {cells: {far: {delay_s: 0.1}}, cell_methods: []}",
            ["gain_study.cells.far.methods = null: must name one or more"],
        ),
        (
            "gain_study: {cells: {far: {delay_s: 1.0e+6}}}",
            ["gain_study.cells.far.delay_s = 1000000.0: 50000000 samples", "at most 200"],
        ),
        (
            "control: {method: lqg, link: playout, playout_s: 5.0}",
            ["control.playout_s = 5.0: 250 samples", "at most 200"],
        ),
        (
            "control: {method: lqg, link: packetised, packet_samples: 200000}",
            ["control.packet_samples = 200000", "less than or equal to 200"],
        ),
        ("control: {known_motion: true}", ["known_motion = true: needs control.method = 'lqg'"]),
        *(
            (f"control: {{method: lqg, known_motion: true}}\nrobot: {robot}", said)
            for robot, said in (
                (
                    "{reference: arc, arc_radius_m: 0.03}",
                    ["robot.arc_radius_m = 0.03", "'arc' turns at up to 33.3333 rad/s", "25.6"],
                ),
                (
                    "{reference: figure_eight, eight_half_width_m: 0.1}",
                    ["robot.eight_half_width_m = 0.1", "up to 30 rad/s"],
                ),
                (
                    "{reference: zigzag, reference_pace: 9.0}",
                    ["robot.reference_pace = 9.0", "'zigzag' turns at up to 37"],
                ),
                (
                    "{reference: reach, reach_duration_s: [0.05, 0.2]}",
                    ["robot.reach_duration_s = (0.05, 0.2)", "'reach' turns at up to"],
                ),
            )
        ),
        (
            "gain_study: {cells: {far: {delays: 0.1}}}",
            ["gain_study.cells.far.delays", "did you mean delay_s"],
        ),
        (
            "gain_study: {cell_methods: [h2, h2]}",
            ["cell_methods = ['h2', 'h2']", "method once"],
        ),
        ("learning: {episodes: 3}", ["learning.num_envs = 16", "learning.episodes = 3"]),
        ("learning: {batch_size: 99999}", ["batch_size = 99999", "replay_capacity = 16000"]),
        ("evaluate: {seeds: [101, 101]}", ["evaluate.seeds = [101, 101]", "every seed once"]),
        ("sweeps: {policies: [pf, pf]}", ["sweeps.policies = ['pf', 'pf']", "every policy once"]),
        ("generalise: {cells: [[20, 10, 25]]}", ["generalise.cells = [20, 10, 25]", "25 PRBs"]),
        ("generalise: {cells: [[1, 1, 2], [1, 1, 2]]}", ["generalise.cells", "every cell once"]),
        ("sweeps: {duration_s: 0.005}", ["sweeps.duration_s = 0.005", "radio.slot_s = 0.01"]),
        (
            "gain_study: {violation_windows: [5, 23]}",
            ["gain_study.violation_windows = 23", "num_windows = 22"],
        ),
        (
            "gain_study: {calm_delay_s: [0.02, 0.005]}",
            ["gain_study.calm_delay_s = [0.02, 0.005]", "lower bound first"],
        ),
        ("gain_study: {weight: [7.0, 7.0]}", ["gain_study.weight = [7.0, 7.0]", "value once"]),
        ("gain_study: {sweep_windows: 1}", ["gain_study.sweep_windows", "greater than or equal"]),
        (
            "gain_study: {noise_position_m: [0.0, 0.1]}",
            ["gain_study.noise_position_m = [0.0, 0.1]", "as many as in", "heading_rad, 4"],
        ),
        (
            "gain_study: {noise_position_m: [0.1, 0.1], noise_heading_rad: [0.2, 0.2]}",
            ["gain_study.noise_position_m = [0.1, 0.1]: every pair", "[0.2, 0.2] once"],
        ),
        # Not a scenario at all.
        ("radio: {num_prb: 25", ["not valid YAML", "line 1"]),
        ("- radio", ["a scenario is a mapping of sections, not list"]),
        ("radio: {num_prb: 25, num_prb: 30}", ["'num_prb' stands twice", "line 1"]),
        ("radio: {num_prb: 25}\nradio: {slot_s: 0.02}", ["'radio' stands twice", "line 2"]),
    ],
)
def test_faults_are_named(load_text, text, parts):
    with pytest.raises(ScenarioError) as caught:
        load_text(text)
    message = str(caught.value)
    assert message.startswith(f"{load_text.path}: ")
    assert [part for part in parts if part not in message] == []


def test_every_fault_is_listed_on_a_line_of_its_own(load_text):
    with pytest.raises(ScenarioError) as caught:
        load_text("radio: {num_prb: 0, slots: 1}\ntraffic: {load: -1.0}")
    lines = str(caught.value).splitlines()
    assert len(lines) == 3
    assert all(line.startswith(f"{load_text.path}: ") for line in lines)


def test_too_few_loads_are_one_fault(load_text):
    """Nothing that reads a load a user is asked then."""
    with pytest.raises(ScenarioError) as caught:
        load_text("users: {num_urllc: 12}")
    (line,) = str(caught.value).splitlines()
    assert "has 10 numbers, and users.num_urllc = 12: must be one number, or 12" in line


def test_a_fault_of_the_defaults_names_the_defaults(tmp_path, config):
    text = (config / "defaults.yaml").read_text(encoding="utf-8")
    defaults, overlay = tmp_path / "defaults.yaml", tmp_path / "case.yaml"
    overlay.write_text("users: {num_embb: 9}\n", encoding="utf-8")
    defaults.write_text(text.replace("num_prb: 25", "num_prb: none"), encoding="utf-8")
    with pytest.raises(ScenarioError, match=r"defaults\.yaml: radio\.num_prb = 'none'"):
        load_scenario(overlay, defaults=defaults)
    defaults.write_text(text.replace("  num_prb: 25", "  # 25"), encoding="utf-8")
    with pytest.raises(ScenarioError, match=r"radio\.num_prb: missing"):
        load_scenario(overlay, defaults=defaults)


def test_missing_files_are_named(tmp_path, config):
    with pytest.raises(ScenarioError, match=r"nowhere\.yaml: no such file"):
        load_scenario(tmp_path / "nowhere.yaml", defaults=config / "defaults.yaml")
    with pytest.raises(ScenarioError, match=r"no such scenario; there are: .*paper.*smoke"):
        find_scenario("papr")
    with pytest.raises(ScenarioError, match=r"gone\.yaml: cannot be read"):
        load_scenario("smoke", defaults=tmp_path / "gone.yaml")


@pytest.mark.parametrize(
    ("name", "kind", "meant"),
    [
        ("papr", "scenario", "paper"),
        ("Smoke", "scenario", "smoke"),
        ("smoke.yml", "file", "smoke"),
        ("mine", "scenario", "mine.yaml"),
        ("elsewhere/mine.yaml", "file", "mine.yaml"),
        ("sub/tought.yaml", "file", "sub/taught.yaml"),
        ("qqqqqqqq", "scenario", None),
    ],
)
def test_an_unknown_scenario_says_which_was_meant(tmp_path, monkeypatch, name, kind, meant):
    """One of the package, one here, or one in the folder that was named."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").touch()
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub/taught.yaml").touch()
    with pytest.raises(ScenarioError) as caught:
        find_scenario(name)
    message = str(caught.value)
    assert message.startswith(f"{name}: no such {kind}; there are: ")
    assert " paper, pendulum, smoke, " in message
    assert message.endswith("hiersched new DIR makes one)")
    assert (f"; did you mean {meant}? (" in message) == (meant is not None)
    assert ("did you mean" in message) == (meant is not None)


def test_an_unknown_policy_says_which_was_meant(load_text):
    with pytest.raises(ScenarioError, match=r"m_lwd is no policy; .*; did you mean m_lwdf\?"):
        load_text("evaluate: {policies: [pf, m_lwd]}\n")
    with pytest.raises(ScenarioError, match=r"'ddpgg': must be one of .*; did you mean ddpg\?"):
        load_text("learning: {algorithm: ddpgg}\n")
