from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hiersched.core.randomness import world_keys
from hiersched.log import LogDims, LogError
from hiersched.scenario import Scenario
from hiersched.simulator import Simulator
from hiersched.study.metrics import run_metrics, tracking_error_by_window_cm

Fields = dict[str, Any]


@pytest.fixture
def known_fields(tiny: Scenario, queue_fields: Callable[..., Fields]) -> Fields:
    """40 slots in which everything can be worked out by hand.

    User 0: two packets a slot and service 4: each takes 1/4 or 1/2 of a slot. User 1: four packets
    in slot 0 and service 1 a slot: 1, 2, 3 and 4 slots, two of them after the deadline of 2 slots.
    User 2 (eMBB) is idle.
    """
    arrivals = np.zeros((40, 3), np.uint32)
    arrivals[:, 0] = 2
    arrivals[0, 1] = 4
    service = np.zeros((40, 3))
    service[:, 0], service[:, 1] = 4.0, 1.0
    return queue_fields(tiny, arrivals, service)


def test_measures_of_a_log_with_known_content(
    tiny: Scenario, tmp_path: Path, write_log: Callable[..., Path], known_fields: Fields
) -> None:
    fields = known_fields
    fields["rate_mbps"][:] = [10.0, 20.0, 30.0]
    error = np.full((40, 2), 0.03)
    error[5:10, 0] = 0.04  # half of robot 0's first window
    error[10:20, 1] = 0.2  # robot 1's second window: off track
    fields["tracking_error_m"] = error
    fields["dexterity_index"][10:20] = 0.5
    fields["dexterity_index"][20:30] = 0.6
    fields["dexterity_index"][30:40] = 0.7
    fields["delay_steps"][:, 1] = 3
    fields["delay_capped"][:4, 0] = 1
    fields["arrival_clamped"][:8, 1] = 1
    fields["control_saturated"][0, 0] = 2
    fields["penalty_embb"][:] = 0.5
    label = {"policy": "edf", "seed": "7", "stage": "sweep", "axis": "load", "value": "1.05"}
    log = write_log(tmp_path / "a.mcap", fields, metadata=label)
    got = run_metrics(log, tiny)

    assert (got.policy, got.seed, got.stage, got.axis, got.value) == tuple(
        [label["policy"], 7, label["stage"], label["axis"], label["value"]]
    )
    assert got.num_slots == 40
    # Packets of the last slot of user 0 fall due behind the run: 39 slots of 2, and 4 of user 1.
    assert got.urllc_late_share == pytest.approx(2 / (39 * 2 + 4))
    assert got.late_share_by_user[:2] == (0.0, 0.5)
    assert np.isnan(got.late_share_by_user[2])
    assert np.isnan(got.embb_late_share)
    assert got.urllc_users_violating == (0.5, 0.5, 0.5, 0.5)
    assert (got.urllc_rate_mbps, got.embb_rate_mbps) == (15.0, 30.0)
    # F of user 1 at the starts of slots: 0, 3, 2, 1; user 0 never waits.
    assert got.urllc_backlog_packets == pytest.approx(6 / 80)
    assert got.embb_backlog_packets == 0.0
    # 40 packets take 0.25, 40 take 0.5, one each 1, 2, 3 and 4 slots of 10 ms.
    assert got.urllc_delay_p50_s == pytest.approx(0.005)
    assert got.urllc_delay_p95_s == pytest.approx(0.005)
    assert got.urllc_delay_p99_s == pytest.approx(0.04)
    assert got.urllc_delay_p999_s == pytest.approx(0.04)
    assert np.isnan(got.embb_delay_p50_s)
    windows = [np.sqrt((0.03**2 + 0.04**2) / 2), *[0.03] * 6, 0.2]
    assert got.tracking_error_cm == pytest.approx(100 * np.mean(windows))
    assert got.off_track_share == pytest.approx(1 / 8)
    assert got.dexterity_index == pytest.approx(0.6)
    assert got.delay_steps == pytest.approx(1.5)
    assert got.delay_capped_share == pytest.approx(4 / 80)
    assert got.arrival_clamped_share == pytest.approx(8 / 80)
    assert got.control_saturations_per_s == pytest.approx(2 / (2 * 0.4))
    assert got.mean_square_backlog == pytest.approx((9 + 4 + 1) / 2 / 40)
    assert got.penalty_cost == pytest.approx(0.5 * 100.0)
    assert (got.urllc_due_packets, got.embb_due_packets) == (39 * 2 + 4, 0)


def test_measures_leave_the_warm_up_out(
    tiny: Scenario, tmp_path: Path, write_log: Callable[..., Path], known_fields: Fields
) -> None:
    """Slots 2 on, windows from slot 10 on; packets of slot 0 fall due in slot 1."""
    fields = known_fields
    fields["rate_mbps"][2:] = 8.0
    fields["tracking_error_m"][:10] = 9.0
    fields["dexterity_index"][20:] = 0.6
    label = {"policy": "edf", "seed": "7", "warmup_slots": "2"}
    got = run_metrics(write_log(tmp_path / "a.mcap", fields, metadata=label), tiny)
    assert got.num_slots == 38
    assert got.urllc_rate_mbps == 8.0
    assert got.urllc_due_packets == 38 * 2  # those of the last slot fall due behind the run
    assert got.urllc_late_share == 0.0
    assert got.urllc_backlog_packets == pytest.approx((2 + 1) / (2 * 38))
    assert got.mean_square_backlog == pytest.approx((4 + 1) / 2 / 38)
    # All packets of user 1 arrived in slot 0: what is left takes 0.25 or 0.5 of a slot of 10 ms.
    assert got.urllc_delay_p999_s == pytest.approx(0.005)
    assert got.tracking_error_cm == 0.0
    assert got.dexterity_index == pytest.approx(0.6)


def test_measures_do_not_credit_a_policy_with_its_own_multiplier(
    tiny: Scenario, tmp_path: Path, write_log: Callable[..., Path], known_fields: Fields
) -> None:
    rng = np.random.default_rng(3)
    for name in ("penalty_urllc", "penalty_embb", "constraint"):
        known_fields[name] = rng.normal(size=known_fields[name].shape)
    priced = dict(known_fields)
    for name in ("multiplier", "reward_urllc", "reward_embb"):
        priced[name] = rng.uniform(1.0, 9.0, known_fields[name].shape)
    logs = [
        write_log(tmp_path / f"{number}.mcap", fields)
        for number, fields in enumerate((known_fields, priced))
    ]
    plain, own = (run_metrics(log, tiny) for log in logs)
    assert repr(own) == repr(plain)  # in which NaN is NaN
    penalty = known_fields["penalty_urllc"] + known_fields["penalty_embb"]
    assert plain.penalty_cost == pytest.approx(tiny.objective.penalty_weight * penalty.mean())


def test_a_share_at_the_allowed_one_is_no_violation(
    tiny: Scenario, tmp_path: Path, write_log: Callable[..., Path], known_fields: Fields
) -> None:
    traffic = replace(tiny.traffic, reliability_levels=(0.5, 0.501))
    log = write_log(tmp_path / "a.mcap", known_fields)
    assert run_metrics(log, replace(tiny, traffic=traffic)).urllc_users_violating == (0.0, 0.5)


@pytest.mark.parametrize("name", ["late_packets", "due_packets"])
def test_a_log_whose_counts_do_not_follow_from_its_queues_is_refused(
    tiny: Scenario, tmp_path: Path, name: str, write_log: Callable[..., Path], known_fields: Fields
) -> None:
    fields = known_fields
    fields[name][5, 1] += 1
    with pytest.raises(LogError, match=f"{name} of user 1 in slot 5 is"):
        run_metrics(write_log(tmp_path / "a.mcap", fields), tiny)


def test_a_log_whose_backlogs_do_not_follow_is_refused(
    tiny: Scenario, tmp_path: Path, write_log: Callable[..., Path], known_fields: Fields
) -> None:
    fields = known_fields
    fields["backlog_packets"][3, 1] = np.nextafter(fields["backlog_packets"][3, 1], 9.0)
    with pytest.raises(LogError, match="backlogs"):
        run_metrics(write_log(tmp_path / "a.mcap", fields), tiny)


def test_a_run_shorter_than_a_window_has_no_tracking_error(
    tiny: Scenario,
    tmp_path: Path,
    write_log: Callable[..., Path],
    zero_fields: Callable[..., Fields],
) -> None:
    got = run_metrics(write_log(tmp_path / "a.mcap", zero_fields(9)), tiny)
    assert np.isnan(got.tracking_error_cm)
    assert np.isnan(got.dexterity_index)


def test_windows_are_root_mean_squares_of_their_slots() -> None:
    rng = np.random.default_rng(0)
    error = rng.uniform(0.0, 0.1, (23, 3))
    windows = tracking_error_by_window_cm(error, 10)
    naive = [
        [100 * np.sqrt(sum(error[10 * w + i, r] ** 2 for i in range(10)) / 10) for r in range(3)]
        for w in range(2)
    ]
    assert windows == pytest.approx(np.array(naive))


def test_the_recomputed_counts_are_the_simulators(
    smoke_scenario: Scenario,
    nominal_gains: Callable[..., Any],
    tmp_path: Path,
    write_log: Callable[..., Path],
) -> None:
    """Exact, over policies that overload some queues: `run_metrics` raises if a count differs."""
    traffic = replace(smoke_scenario.traffic, load=1.05, deadline_s=0.017)
    scenario = replace(smoke_scenario, traffic=traffic)
    urllc = scenario.users.num_urllc
    dims = LogDims(num_urllc=urllc, num_embb=scenario.users.num_embb, num_prb=10)
    keys = world_keys("evaluate", 3, 2)
    simulator = Simulator(scenario, nominal_gains(scenario), keys, 500)
    for policy in ("pf", "max_rate", "drift_plus_penalty"):
        simulator.reset(keys)
        record = simulator.run(policy)
        for env in range(2):
            log = write_log(tmp_path / "a.mcap", record.environment(env), dims)
            got = run_metrics(log, scenario)
            late, due = (
                getattr(record, name)[env, :, :urllc].sum()
                for name in ("late_packets", "due_packets")
            )
            assert got.urllc_late_share == late / due
