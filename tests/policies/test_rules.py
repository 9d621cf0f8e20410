"""Each scheduler's hand-computed case: the numbers are worked out beside it."""

from __future__ import annotations

import math

import numpy as np
import pytest

# User 0 has the better channel, user 1 its best on PRB 1.
RATE = [[9, 8, 7], [1, 3, 2.5]]


@pytest.fixture(scope="session")
def weights(decide_by_hand):
    """Weights of a rule's users."""

    def of(name, *, backlog=1.0, hol=0.0, average=10.0, deadline=0.02, late=0.05, num_urllc=2,
           num_users=2):  # fmt: skip
        simulator, _ = decide_by_hand(
            name,
            np.ones((num_users, num_users)),
            backlog_packets=backlog,
            hol_delay_s=hol,
            average_rate_mbps=average,
            deadline_s=deadline,
            late_share=late,
            num_urllc=num_urllc,
        )
        return simulator.state.index_weight[0].copy()

    return of


def test_pf(schedule):
    """One PRB each: 9 · 3 = 27 is the largest product (27, 22.5, 8, 20, 7, 21).

    PRB 2: user 0 gains log(16/9) = 0.575, user 1 log(5.5/3) = 0.606.
    """
    assert schedule("pf", RATE) == [0, 1, 1]


def test_weighted_pf(schedule):
    """Weights 1, 2 over [9 4 2], [6 1 3]: first the largest of r0 · r1².

    9 · 1, 9 · 9 = 81, 4 · 36 = 144, 4 · 9, 2 · 36 = 72, 2 · 1: PRB 1 and PRB 0. PRB 2: user 0 gains
    log(6/4) = 0.405, user 1 2 log(9/6) = 0.811. With equal weights: 27 is the largest (PRB 0, PRB
    2), and PRB 1 gives log(13/9) = 0.368 against log(4/3) = 0.288.
    """
    rate = [[9, 4, 2], [6, 1, 3]]
    assert schedule("pf", rate, weight=[1.0, 2.0]) == [1, 0, 1]
    assert schedule("pf", rate) == [0, 0, 1]


def test_max_rate(schedule):
    """One PRB each: 9 + 3 = 12 is the largest sum; PRB 2 carries 7 or 2.5."""
    assert schedule("max_rate", RATE) == [0, 1, 0]


def test_pf_average(schedule):
    """Averages 10 and 2: r / R is [.9 .8 .7] and [.5 1.5 1.25].

    One each: .9 + 1.5; PRB 2: .7 against 1.25. Averages 2 and 10: [4.5 4 3.5], [.1 .3 .25].
    """
    assert schedule("pf_average", RATE, average_rate_mbps=[10.0, 2.0]) == [0, 1, 1]
    assert schedule("pf_average", RATE, average_rate_mbps=[2.0, 10.0]) == [0, 1, 0]


def test_round_robin(schedule):
    rate = np.ones((3, 4))
    assert [schedule("round_robin", rate, slot=slot) for slot in range(3)] == [
        [0, 1, 2, 0],
        [1, 2, 0, 1],
        [2, 0, 1, 2],
    ]


def test_max_weight(schedule, weights):
    """Queue times rate, whatever the delays: F = 1, 5 gives [9 8 7], [5 15 12.5]."""
    waits = [0.3, 0.001]
    assert schedule("max_weight", RATE, backlog_packets=[1.0, 5.0], hol_delay_s=waits) == [0, 1, 1]
    assert schedule("max_weight", RATE, backlog_packets=[5.0, 1.0], hol_delay_s=waits) == [0, 1, 0]
    np.testing.assert_array_equal(weights("max_weight", backlog=[1.0, 5.0]), [1.0, 5.0])
    # A factor 5 on user 0 makes both equal.
    given = {"backlog_packets": [1.0, 5.0], "weight": [5.0, 1.0]}
    assert schedule("max_weight", RATE, **given) == [0, 1, 0]


def test_m_lwdf(schedule, weights):
    """−log10(δ)/D · W/R: 2/0.02 · 0.001/10 = 0.01 and 1/0.1 · 0.04/10 = 0.04.

    Times rate [.09 .08 .07], [.04 .12 .10]: PRB 2 goes to user 1. Ten times user 0's wait: 0.1, and
    [.9 .8 .7] wins it.
    """
    rules = {"deadline_s": [0.02, 0.1], "late_share": [0.01, 0.1]}
    assert schedule("m_lwdf", RATE, hol_delay_s=[0.001, 0.04], **rules) == [0, 1, 1]
    assert schedule("m_lwdf", RATE, hol_delay_s=[0.01, 0.04], **rules) == [0, 1, 0]
    got = weights("m_lwdf", hol=[0.001, 0.04], deadline=[0.02, 0.1], late=[0.01, 0.1])
    np.testing.assert_allclose(got, [0.01, 0.04], rtol=1e-14)


def test_exp_pf(schedule, weights):
    """Two URLLC users and one eMBB user, δ = 0.01: a = 2/0.02 = 100 and 2/0.04 = 50.

    W = 20 ms: a W = 2 and 1, mean 1.5, exponents ±0.5/(1 + √1.5) = ±0.22474. R = 10, 10, 20. The
    weights are e^0.22474/10 : e^−0.22474/10 : 1/20.
    """
    rules = {"deadline": [0.02, 0.04, 0.3], "late": [0.01, 0.01, 0.1]}
    got = weights(
        "exp_pf",
        hol=[0.02, 0.02, 0.2],
        average=[10.0, 10.0, 20.0],
        num_urllc=2,
        num_users=3,
        **rules,
    )
    e = 0.5 / (1 + math.sqrt(1.5))
    expected = np.array([math.exp(e) / 10, math.exp(-e) / 10, 1 / 20])
    np.testing.assert_allclose(got / got[0], expected / expected[0], rtol=1e-14)
    # On equal channels the fourth PRB goes to the greatest weight: user 0; when user 1 has waited
    # longer (a W = 2 and 4), to user 1.
    for waits, winner in (([0.02, 0.02, 0.2], 0), ([0.02, 0.08, 0.2], 1)):
        owner = schedule(
            "exp_pf", np.ones((3, 4)), hol_delay_s=waits, num_urllc=2,
            average_rate_mbps=[10.0, 10.0, 20.0],
            deadline_s=rules["deadline"], late_share=rules["late"],
        )  # fmt: skip
        assert owner.count(winner) == 2


def test_exp_pf_is_finite_after_a_long_wait(weights):
    got = weights("exp_pf", hol=[1e5, 0.0, 0.0], num_urllc=2, num_users=3)
    assert np.isfinite(got).all()
    assert got.argmax() == 0


def test_log_rule(schedule, weights):
    """log(1.1 + 5 W/D) / R: W = 0 gives log 1.1 = 0.0953, W = D log 6.1 = 1.808 (R = 10).

    Times rate [.086 .076 .067], [.18 .54 .45]; the other way round user 0 wins everything free.
    """
    assert schedule("log_rule", RATE, hol_delay_s=[0.0, 0.02]) == [0, 1, 1]
    assert schedule("log_rule", RATE, hol_delay_s=[0.02, 0.0]) == [0, 1, 0]
    got = weights("log_rule", hol=[0.0, 0.02])
    np.testing.assert_allclose(got, [math.log(1.1) / 10, math.log(6.1) / 10], rtol=1e-14)


def test_edf_serves_the_least_time_left_first(schedule):
    """D − W: 20 − 5 = 15 ms and 300 − 295 = 5 ms: user 1, with the longer deadline, is first.

    User 1 takes its best, PRB 1 (8); user 0 takes PRB 0 (9); PRB 2 goes to user 1 while its need
    (10 packets, 1 a Mbit/s) is not met, and to user 0 (need 20) when user 1's is (5 packets).
    """
    rate = [[9, 8.5, 7], [5, 8, 4]]
    given = {"hol_delay_s": [0.005, 0.295], "deadline_s": [0.02, 0.3]}
    assert schedule("edf", rate, backlog_packets=[20.0, 10.0], **given) == [0, 1, 1]
    assert schedule("edf", rate, backlog_packets=[20.0, 5.0], **given) == [0, 1, 0]
    # A service offset (beta DI = 4 Mbit/s) comes on top of the need: 5 + 4 > 8.
    assert schedule("edf", rate, backlog_packets=[20.0, 5.0], service_offset_mbps=4.0, **given) == [
        0,
        1,
        1,
    ]
    # 20 − 18 = 2 ms against 300 − 290 = 10 ms: user 0 first, and its need of 20 takes PRB 2 too.
    waits = {"hol_delay_s": [0.018, 0.290], "deadline_s": [0.02, 0.3]}
    assert schedule("edf", rate, backlog_packets=[20.0, 20.0], **waits) == [0, 1, 0]


def test_drift_plus_penalty(schedule):
    """F = 10 and 0, no arrivals: user 0's ½([10 − r]⁺² − 100), and V / r² for both (ε ≈ 0).

    V = 1, one each: (PRB 0, PRB 1) −49.5 + 1/81 + 1/9 is least. PRB 2: user 0 goes to r = 16,
    L = −50 + 1/256, and gains 0.508; user 1 gains 1/9 − 1/5.5² = 0.078. V = 10: 0.584, 0.781.
    """
    given = {"backlog_packets": [10.0, 0.0], "epsilon": 1e-12}
    assert schedule("drift_plus_penalty", RATE, penalty_weight=1.0, **given) == [0, 1, 0]
    assert schedule("drift_plus_penalty", RATE, penalty_weight=10.0, **given) == [0, 1, 1]
    # λ = 20 on user 1 prices its delay: 20 (e^(−0.16·3) − e^(−0.16·5.5)) = 4.08 more than 0.508.
    assert schedule(
        "drift_plus_penalty", RATE, penalty_weight=1.0, multiplier=[0.0, 20.0], **given
    ) == [0, 1, 1]
    # A factor 10 on user 1: 0.78 more than 0.508.
    assert schedule(
        "drift_plus_penalty", RATE, penalty_weight=1.0, weight=[1.0, 10.0], **given
    ) == [0, 1, 1]


def test_no_user_is_given_more_than_it_needs(schedule):
    """Queues of 4 and 20 packets, 1 a Mbit/s: 4 · [9 8 7] and 20 · [1 3 2.5] without a cap.

    One each: user 1 takes its best, PRB 1; user 0 has all it needs with PRB 0. PRB 2 is worth
    28 to user 0 without a cap against 50; with it 0 against 50. Queues of 40 and 3: 40 · 7 against
    3 · 2.5 without a cap, and nobody else needs it with one of 9: user 1 has its 3 with PRB 1.
    """
    rate = [[9, 8, 7], [1, 3, 2.5]]
    assert schedule("max_weight", rate, backlog_packets=[4.0, 20.0]) == [0, 1, 1]
    for need, winner in (("none", 0), ("backlog", 1)):
        # 9 packets are served by PRB 0; a service offset of 1 Mbit/s asks for 10 and takes PRB 2.
        given = {"backlog_packets": [9.0, 4.0], "need": need}
        assert schedule("max_weight", rate, **given) == [0, 1, winner]
        assert schedule("max_weight", rate, service_offset_mbps=1.0, **given) == [0, 1, 0]


def test_what_nobody_needs_goes_by_pf(schedule):
    """Empty queues: what plain PF does, whatever the rule; 5.5 / 3 is more than 16 / 9 (PRB 2)."""
    for name in ("max_weight", "m_lwdf", "exp_pf", "log_rule"):
        assert schedule(name, RATE, backlog_packets=0.0, need="backlog") == [0, 1, 1]
        assert schedule("pf", RATE) == [0, 1, 1]


def test_arrivals_count_as_need_at_the_last_rate(schedule):
    """Mean arrivals (12 − 0.5 · 4) · 0.1 = 1 packet a user: both are equal, user 0's 9 wins.

    At a last rate of 24 there are none, and PRBs go by PF: PRB 2 to user 1.
    """
    given = {
        "backlog_packets": 0.0,
        "offered_mbps": 12.0,
        "rate_sensitivity": 0.5,
        "arrival_packets_per_mbps": 0.1,
        "service_packets_per_mbps": 0.05,  # 1 packet takes 20 Mbit/s
        "need": "backlog_and_arrivals",
    }
    assert schedule("max_weight", RATE, last_rate_mbps=4.0, **given) == [0, 1, 0]
    assert schedule("max_weight", RATE, last_rate_mbps=24.0, **given) == [0, 1, 1]
