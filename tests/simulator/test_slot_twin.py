"""A plain twin of a whole slot: rates, arrivals, queues, Lagrangian, rewards."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats


def twin(scenario, record, t):
    """Recompute slot t (all environments) from the world, the owners and the state before it."""
    s, n = scenario, scenario.users.num_urllc
    tau, packet_mbit = s.radio.slot_s, s.traffic.packet_bits * 1e-6
    snr = 10 ** ((s.radio.tx_power_dbm - s.radio.noise_dbm) / 10)
    prb_mhz = s.radio.bandwidth_hz / s.radio.num_prb * 1e-6
    h2 = record.fading_power[:, t].astype(np.float64)
    prb_rate = (prb_mhz * np.log2(1 + snr * h2)).astype(np.float32).astype(np.float64)
    mask = record.prb_owner[:, t, None, :] == np.arange(s.num_users)[:, None]
    r = (prb_rate * mask).sum(axis=-1)
    # Arrivals: λ0 such that the offered load holds at the reference rate; D_i = the deadline.
    load, alpha = s.traffic.load, s.traffic.arrivals.rate_sensitivity
    interval_s = tau + s.traffic.deadline_s
    urllc = load * np.array(s.traffic.urllc_offered_mbps)
    base = urllc * tau / interval_s + alpha * s.traffic.arrivals.reference_rate_mbps
    wanted = np.full_like(r, load * s.traffic.embb_offered_mbps)
    wanted[:, :n] = base - alpha * r[:, :n]
    seconds = np.where(np.arange(s.num_users) < n, interval_s, tau)
    batch = s.traffic.arrivals.batch_packets
    mean = np.maximum(0, wanted) * seconds / packet_mbit / batch
    arrivals = batch * stats.poisson.ppf(record.arrival_uniform[:, t], mean)
    offset = np.zeros_like(r)
    offset[:, :n] = s.traffic.service_coefficient_mbps * record.dexterity_index[:, t]
    service = np.maximum(0, r - offset) * (tau / packet_mbit)
    before = record.backlog_packets[:, t]
    after = np.maximum(0, before + arrivals - service)
    drift = 0.5 * (after**2 - before**2)
    penalty = 1 / (r**2 + s.objective.epsilon)
    chi = s.traffic.reliability
    if s.objective.constraint == "surrogate":
        y = (1 - chi) - np.exp(-s.objective.delay_exponent * s.traffic.deadline_s * r[:, :n])
    else:
        due, late = record.due_packets[:, t, :n], record.late_packets[:, t, :n].astype(float)
        y = ((1 - chi) * due - late) / (urllc * tau / packet_mbit)
    forgetting = 1 / s.schedulers.average_window_slots
    average = record.average_rate_mbps[:, t]
    price = (record.multiplier[:, t] * y).sum(axis=1)
    V, scale = s.objective.penalty_weight, s.learning.reward_scale
    parts = {
        "drift_urllc": drift[:, :n].sum(axis=1),
        "drift_embb": drift[:, n:].sum(axis=1),
        "penalty_urllc": penalty[:, :n].sum(axis=1),
        "penalty_embb": penalty[:, n:].sum(axis=1),
    }
    return {
        "exact": {
            "rate_mbps": r,
            "num_prb": mask.sum(axis=-1),
            "arrival_clamped": wanted < 0,
            "arrivals_packets": arrivals,
            "service_packets": service,
            "after": after,
        },
        "close": {
            **parts,
            "constraint": y,
            "reward_urllc": -(parts["drift_urllc"] + V * parts["penalty_urllc"] - price)
            / (n * scale),
            "reward_embb": -(parts["drift_embb"] + V * parts["penalty_embb"])
            / ((s.num_users - n) * scale),
        },
        "average": average + forgetting * (r - average),
    }


def assert_twin(simulator, record):
    """Every slot of the record against the twin's."""
    num_slots = record.prb_owner.shape[1]
    for t in range(num_slots):
        expected = twin(simulator.scenario, record, t)
        after = expected["exact"].pop("after")
        last = t == num_slots - 1
        state = simulator.state
        following = state.backlog_packets if last else record.backlog_packets[:, t + 1]
        np.testing.assert_array_equal(following, after)
        for name, value in expected["exact"].items():
            np.testing.assert_array_equal(getattr(record, name)[:, t], value, err_msg=name)
        for name, value in expected["close"].items():
            got = getattr(record, name)[:, t]
            np.testing.assert_allclose(got, value, rtol=1e-12, atol=1e-12, err_msg=name)
        average = state.average_rate_mbps if last else record.average_rate_mbps[:, t + 1]
        np.testing.assert_allclose(average, expected["average"], rtol=1e-14)


@pytest.mark.parametrize(
    ("policy", "sections"),
    [
        ("pf", {"objective": {"constraint": "measured"}, "traffic": {"load": 1.1}}),
        ("max_weight", {"objective": {"constraint": "surrogate"}}),
        # Noisy channel and one PRB carrying far more than is wanted: the clamp acts.
        ("edf", {"radio": {"noise_dbm": 15.0}, "traffic": {"arrivals": {"batch_packets": 1}}}),
        # Rates far above what was assumed: the clamp of the arrivals acts.
        (
            "max_rate",
            {"traffic": {"arrivals": {"rate_sensitivity": 0.4, "reference_rate_mbps": 5.0}}},
        ),
    ],
)
def test_slots_are_the_twins(make_simulator, policy, sections):
    simulator = make_simulator(3, 120, **sections)
    multipliers = np.random.default_rng(1).uniform(0, 3, (3, 4))
    record = simulator.run(policy, multipliers=multipliers)
    assert record.late_packets.any() or policy != "pf"
    assert record.arrival_clamped.any() or policy != "max_rate"
    assert_twin(simulator, record)


def test_every_slot_is_that_of_the_twin_beyond_one_block_of_users(make_simulator):
    """36 users fill one block of lanes and begin another."""
    many = {
        "users": {"num_urllc": 20, "num_embb": 16},
        "radio": {"num_prb": 40},
        "traffic": {"urllc_offered_mbps": tuple(10.0 + 0.5 * i for i in range(20))},
    }
    simulator = make_simulator(1, 60, **many)
    record = simulator.run("pf", multipliers=np.linspace(0, 3, 20)[None])
    assert record.late_packets.any()
    assert_twin(simulator, record)


def test_average_rate_starts_at_one_prbs_rate(make_simulator):
    simulator = make_simulator()
    alone = simulator.state.prb_rate_mbps.astype(np.float64).mean(axis=-1)
    np.testing.assert_allclose(simulator.state.average_rate_mbps, alone, rtol=1e-14)


def test_delays_in_the_record_are_those_of_single_packets(make_simulator):
    """Follow every packet of the record: sojourn of the last one delivered, due, late, HOL wait."""
    simulator = make_simulator(1, 200, traffic={"load": 1.1})
    record, slot_s = simulator.run("pf"), simulator.scenario.radio.slot_s
    for user, deadline_slots in ((0, 2), (3, 2), (6, 30)):
        total, births, work_done = 0, [], 0.0
        fields = (record.arrivals_packets, record.service_packets, record.backlog_packets)
        finish = {}
        for t, (a, mu, f) in enumerate(zip(*(x[0, :, user].tolist() for x in fields), strict=True)):
            hol = (t - births[len(finish)]) * slot_s if len(finish) < total else 0.0
            assert record.hol_delay_s[0, t, user] == pytest.approx(hol, abs=1e-12)
            births += [t] * a
            total += a
            work_done = total - max(0.0, f + a - mu)
            last = len(finish)
            while len(finish) < int(work_done):
                number = len(finish)  # waits for all work up to its own
                finish[number] = t + (number + 1 - (total - f - a)) / mu
            if len(finish) > last:
                sojourn = finish[len(finish) - 1] - births[len(finish) - 1]
            else:
                sojourn = t + 1 - births[len(finish)] if len(finish) < total else 0.0
            assert record.delay_s[0, t, user] == pytest.approx(sojourn * slot_s, abs=1e-10)
            due = [p for p, born in enumerate(births) if born + deadline_slots == t + 1]
            late = sum(p not in finish or finish[p] > t + 1 for p in due)
            assert record.due_packets[0, t, user] == len(due)
            assert record.late_packets[0, t, user] == late
    np.testing.assert_array_equal(
        record.network_delay_s, record.delay_s[:, :, :4] + simulator.scenario.robot.core_latency_s
    )
