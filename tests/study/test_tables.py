from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from hiersched.log import LogReader
from hiersched.scenario import Scenario
from hiersched.simulator.loop_gains import plant_of
from hiersched.study.metrics import run_metrics
from hiersched.study.statistics import skewed_interval, smallest_mean
from hiersched.study.study import Study
from hiersched.study.tables.paper import rate_table
from hiersched.study.tables.policies import (
    BACKLOG,
    all_measures,
    best_classical,
    comparison_table,
    policy_table,
    score_table,
)
from hiersched.study.tables.text import interval_text, markdown_text

SYMMETRIC = "urllc_rate_mbps embb_rate_mbps dexterity_index".split()
SKEWED = (
    "urllc_backlog_packets embb_backlog_packets urllc_delay_p99_s tracking_error_cm "
    "mean_square_backlog penalty_cost"
).split()


def logs_of(results: Path, scenario: Scenario, policy: str) -> list[Path]:
    """Logs of a policy's evaluation."""
    folder = results / "runs/evaluate" / policy
    return [folder / f"seed{seed}.mcap" for seed in scenario.evaluate.seeds]


def test_policies_have_means_medians_and_the_interval_that_suits_a_measure(
    tables: dict[str, pd.DataFrame], results: Path, tiny: Scenario
) -> None:
    table = tables["policies"].set_index("policy")
    assert list(table.index) == ["ddpg", "pf", "drift_plus_penalty", "alt"]
    assert (table["seeds"] == 3).all()
    assert table["training_seeds"].to_dict() == {
        **{"ddpg": 2, "alt": 2},
        **{"pf": 0, "drift_plus_penalty": 0},
    }
    for policy in ("pf", "drift_plus_penalty"):
        runs = [run_metrics(log, tiny) for log in logs_of(results, tiny, policy)]

        def check(
            name: str, interval: tuple[float, float], policy: str, values: list[float]
        ) -> None:
            row = table.loc[policy, [name, f"{name}_lo", f"{name}_hi"]].to_numpy(float)
            expected = [np.mean(values), *interval]
            assert row == pytest.approx(expected, rel=1e-12, nan_ok=True), name
            assert table.loc[policy, f"{name}_median"] == pytest.approx(np.median(values))

        for name in SYMMETRIC:
            values = [getattr(run, name) for run in runs]
            check(name, stats.ttest_1samp(values, 0.0).confidence_interval(0.95), policy, values)
        for name in SKEWED:
            values = [getattr(run, name) for run in runs]
            check(name, skewed_interval(values)[1:], policy, values)
        for part in ("urllc", "embb"):
            values = [getattr(run, f"{part}_late_share") for run in runs]
            least = 4.0 / min(getattr(run, f"{part}_due_packets") for run in runs)
            interval = skewed_interval(values, resolution=least, most=1.0)[1:]
            check(f"{part}_late_share", interval, policy, values)


def crossed(tables: dict[str, pd.DataFrame], policy: str, name: str) -> np.ndarray:
    """A measure of the evaluation, training seeds by worlds."""
    runs = tables["runs"].query("stage == 'evaluate' and policy == @policy")
    return runs.pivot(index="policy_seed", columns="seed", values=name).to_numpy()


def by_world(tables: dict[str, pd.DataFrame], policy: str, name: str) -> np.ndarray:
    """A measure of the evaluation of a rule, by world."""
    return tables["runs"].query("stage == 'evaluate' and policy == @policy")[name].to_numpy()


def crossed_t(values: np.ndarray) -> list[float]:
    """By hand: mean and interval of policies crossed with worlds, Satterthwaite's freedom."""
    (policies, worlds), mean = values.shape, values.mean()
    a = ((values.mean(axis=1) - mean) ** 2).sum() / (policies - 1) / policies
    b = ((values.mean(axis=0) - mean) ** 2).sum() / (worlds - 1) / worlds
    freedom = (a + b) ** 2 / (a**2 / (policies - 1) + b**2 / (worlds - 1))
    half = stats.t.ppf(0.975, freedom) * math.sqrt(a + b)
    return [mean, mean - half, mean + half]


def test_learned_policies_are_crossed_with_worlds(tables: dict[str, pd.DataFrame]) -> None:
    table = tables["policies"].set_index("policy")
    for name in SYMMETRIC:
        row = table.loc["ddpg", [name, f"{name}_lo", f"{name}_hi"]].tolist()
        assert row == pytest.approx(crossed_t(crossed(tables, "ddpg", name)))
    for name in SKEWED:
        values = crossed(tables, "ddpg", name)
        row = table.loc["ddpg", [name, f"{name}_lo", f"{name}_hi"]].tolist()
        assert row == pytest.approx(skewed_interval(values)), name
        assert row != pytest.approx(skewed_interval(values.ravel())), name
        assert table.loc["ddpg", f"{name}_median"] == pytest.approx(np.median(values))


def test_runs_say_whose_policy_in_which_world_and_whether_there_is_a_log(
    tables: dict[str, pd.DataFrame], study: Study
) -> None:
    runs = tables["runs"]
    assert list(runs.columns[:4]) == ["policy", "policy_seed", "seed", "logged"]
    assert len(runs) == len(study.runs)
    assert runs["stage"].unique().tolist() == ["evaluate", "generalise", "sweep"]
    for name in (*SYMMETRIC, *SKEWED):
        assert sorted(runs[name]) == sorted(study.runs[name])  # to the last bit


def late_runs(scenario: Scenario, samples: dict[str, list[float]]) -> pd.DataFrame:
    """Runs of 1000 due packets each with these late shares, all other measures 0.5."""
    common = {**dict.fromkeys(all_measures(scenario), 0.5), "num_slots": 100}
    common |= {"urllc_due_packets": 1000, "embb_due_packets": 1000, "stage": "evaluate"}
    rows = [
        {**common, "policy": policy, "seed": seed, "urllc_late_share": share}
        for policy, shares in samples.items()
        for seed, share in enumerate(shares)
    ]
    return pd.DataFrame(rows)


def test_a_late_share_of_0_has_the_bound_that_the_worlds_give(
    tiny: Scenario, planted: Callable[..., Study]
) -> None:
    """Batches of 4 of 1000 packets, five worlds: 1 - 0.05^(1/5) = 0.4507 of 0.004."""
    samples = {"ddpg": [0.0, 0.0, 0.004, 0.02, 0.5], "pf": [0.0] * 5, "alt": [0.25] * 5}
    table = policy_table(planted(tiny, runs=late_runs(tiny, samples))).set_index("policy")
    late = "urllc_late_share"
    assert table[f"{late}_smallest"].tolist() == pytest.approx([0.0018029] * 3, rel=1e-4)
    assert table[f"{late}_smallest"].iloc[0] == smallest_mean(5, 0.004)
    assert table[f"{late}_median"].tolist() == [0.004, 0.0, 0.25]
    bounds = table[[late, f"{late}_lo", f"{late}_hi"]]
    assert bounds.loc["pf"].tolist() == [0.0, 0.0, table.loc["pf", f"{late}_smallest"]]
    assert bounds.loc["alt"].tolist() == [0.25, 0.25, 0.25]
    assert 0.0 < bounds.loc["ddpg", f"{late}_lo"] < 0.1048
    assert bounds.loc["ddpg", f"{late}_hi"] == 1.0  # cut: a share is no more
    text = markdown_text(bounds.reset_index(), "T", "N")
    assert "| pf | < 0.0018 |" in text


def test_a_ratio_over_shares_of_0_is_bounded_from_below(
    tiny: Scenario, planted: Callable[..., Study]
) -> None:
    """PF is late in no world, so its share is below the 0.004 of a batch of 4 of 1000 packets."""
    samples = {"ddpg": [0.04, 0.08, 0.16], "pf": [0.0] * 3, "alt": [0.0, 0.0, 0.1]}
    table = comparison_table(planted(tiny, runs=late_runs(tiny, samples)))
    rows = table[table["measure"] == "urllc_late_share"].set_index(["policy", "baseline"])
    ratio = rows[["ratio", "ratio_lo", "ratio_hi"]]
    low, _ = stats.ttest_1samp(np.log([10.0, 20.0, 40.0]), 0.0).confidence_interval(0.95)
    expected = [20.0, math.exp(low), math.inf]
    assert ratio.loc[("ddpg", "pf")].tolist() == pytest.approx(expected)
    assert ratio.loc[("alt", "pf")].isna().all()


def test_saturations_that_never_come_have_a_bound(
    tiny: Scenario, planted: Callable[..., Study]
) -> None:
    """One of two robots in one of 100 slots of 10 ms would be half a saturation a second."""
    runs = late_runs(tiny, {"pf": [0.0] * 5}).assign(control_saturations_per_s=0.0)
    row = policy_table(planted(tiny, runs=runs)).iloc[0]
    assert row["control_saturations_per_s_hi"] == pytest.approx(smallest_mean(5, 0.5))


@pytest.mark.parametrize("name", ["policies", "comparison"])
def test_notes_say_what_the_learned_policys_interval_mixes(written: Path, name: str) -> None:
    text = (written / "tables" / f"{name}.md").read_text()
    assert "every trained policy in every world" in text


def test_csv_numbers_read_back_to_the_same_bits(
    tables: dict[str, pd.DataFrame], results: Path, tiny: Scenario
) -> None:
    rates = [run_metrics(log, tiny).urllc_rate_mbps for log in logs_of(results, tiny, "pf")]
    row = tables["policies"].set_index("policy").loc["pf"]
    assert row["urllc_rate_mbps"] == np.mean(rates)


def test_gain_table_has_the_planted_ratios(tables: dict[str, pd.DataFrame]) -> None:
    table = tables["table2_gain"]
    assert list(table.columns[:6]) == [
        *["slot", "nominal_cm", "adjusted_cm", "ratio", "ratio_lo", "ratio_hi"]
    ]
    assert table["slot"].tolist() == [5, 10, 20]
    nominal = np.array([1.8, 2.0, 2.2])
    adjusted = nominal * [0.49, 0.50, 0.51]
    assert table["nominal_cm"].to_numpy() == pytest.approx(np.full(3, 2.0))
    assert table["adjusted_cm"].to_numpy() == pytest.approx(np.full(3, adjusted.mean()))
    assert table["ratio"].to_numpy() == pytest.approx(np.full(3, stats.gmean(adjusted / nominal)))
    for bound in table["ratio_lo"].tolist() + table["ratio_hi"].tolist():
        logarithms = np.log(adjusted / nominal)
        assert stats.ttest_1samp(logarithms, np.log(bound)).pvalue == pytest.approx(0.05)
    assert table["paper_ratio"].to_numpy() == pytest.approx([0.78967, 0.71207, 0.64864], abs=1e-5)
    assert set(table["method"] + table["plant"]) == {"krasovskiinetwork"}
    calm = tables["table2_methods"].query("not violated")
    assert len(calm) == 3 * 19
    assert calm["ratio"].to_numpy() == pytest.approx(np.ones(3 * 19))


def test_rate_table_reads_the_fifth_tenth_and_fifteenth_slot(
    tables: dict[str, pd.DataFrame], results: Path, tiny: Scenario
) -> None:
    table = tables["table3_rate"].set_index("slot")
    assert list(table.index) == ["5", "10", "15", "mean"]
    for policy, column in (("ddpg", "drl_mbps"), ("pf", "pf_mbps")):
        rates = []
        for path in logs_of(results, tiny, policy):
            with LogReader(path) as log:
                rates.append(log.read("/allocation")["rate_mbps"][:, :2].mean(axis=1))
        for slot in (5, 10, 15):
            mean = np.mean([rate[slot - 1] for rate in rates])
            assert table.loc[str(slot), column] == pytest.approx(mean)
        assert table.loc["mean", column] == pytest.approx(np.mean([rate[4:] for rate in rates]))
    assert table.loc["10", "paper_drl_mbps"] == 19.6458


def test_comparison_is_paired_with_pf(
    tables: dict[str, pd.DataFrame], results: Path, tiny: Scenario
) -> None:
    table = tables["comparison"].query("baseline == 'pf'").set_index(["policy", "measure"])
    assert set(table.index.get_level_values(0)) == {"ddpg", "drift_plus_penalty", "alt"}
    pf = [run_metrics(log, tiny) for log in logs_of(results, tiny, "pf")]
    own = crossed(tables, "ddpg", "urllc_late_share")
    baseline = np.array([run.urllc_late_share for run in pf])
    row = table.loc[("ddpg", "urllc_late_share")]
    expected = crossed_t(own - baseline)  # world by world within each policy
    assert row[["difference", "difference_lo", "difference_hi"]].tolist() == pytest.approx(expected)
    assert row["seeds_below_baseline"] == (own < baseline).sum()
    assert (row["seeds"], row["training_seeds"]) == (3, 2)
    own = crossed(tables, "ddpg", "mean_square_backlog")
    expected = crossed_t(np.log(own) - np.log([run.mean_square_backlog for run in pf]))
    row = table.loc[("ddpg", "mean_square_backlog")]
    assert row[["ratio", "ratio_lo", "ratio_hi"]].tolist() == pytest.approx(np.exp(expected))
    rule = table.loc[("drift_plus_penalty", "mean_square_backlog")]
    other = by_world(tables, "drift_plus_penalty", "mean_square_backlog")
    bounds = stats.ttest_rel(
        np.log(other), np.log([run.mean_square_backlog for run in pf])
    ).confidence_interval(0.95)
    assert [rule["ratio_lo"], rule["ratio_hi"]] == pytest.approx(np.exp([*bounds]).tolist())


def test_sweeps_have_every_axis_value_and_policy(
    tables: dict[str, pd.DataFrame], results: Path, tiny: Scenario
) -> None:
    table = tables["sweeps"]
    assert len(table) == 4 * 2 * 2 + 2 * 2 + 2 * 2 + 2 * 2 * 2
    along = table.groupby("axis")
    assert along["policy"].nunique()["load"] == 4  # all that are evaluated
    assert along["value"].nunique()["service_coefficient_mbps"] == 4  # by sampling interval
    assert table["value"].tolist()[0] == "0.5"
    row = table.query("axis == 'reference' and value == 'arc' and policy == 'pf'").iloc[0]
    logs = [results / f"runs/reference/arc/pf/seed{s}.mcap" for s in tiny.sweeps.seeds]
    rates = [run_metrics(log, tiny).embb_rate_mbps for log in logs]
    assert row["embb_rate_mbps"] == np.mean(rates)


def test_gains_say_what_is_certified(tables: dict[str, pd.DataFrame], tiny: Scenario) -> None:
    table = tables["gains"]
    assert table["method"].unique().tolist() == ["krasovskii", "razumikhin", "predictor"]
    assert table["plant"].unique().tolist() == ["network", "split"]
    table = table[:13]
    assert table["delay_steps"].tolist() == list(range(13))
    status = [*["nominal"] * 4, *["adjusted"] * 8, "infeasible"]
    assert table["status"].tolist() == status
    assert table["certified"].tolist() == [name != "infeasible" for name in status]
    assert ((table["deviation"] > 0.0) == (table["status"] == "adjusted")).all()
    assert table["spectral_radius"].to_numpy() == pytest.approx([0.9, *[0.95] * 12])
    # The nominal loop itself: stable without delay, and the less so the longer the delay.
    nominal = table["nominal_spectral_radius"].to_numpy()
    plant = plant_of(tiny)
    A_c, A_d = plant.closed_loop(plant.nominal_gain)
    assert nominal[0] == pytest.approx(np.abs(np.linalg.eigvals(A_c + A_d)).max())
    assert nominal[0] < 1.0
    assert (np.diff(nominal) >= 0.0).all()


def test_parameters_have_unit_and_origin(tables: dict[str, pd.DataFrame]) -> None:
    table = tables["table1_parameters"].set_index("key")
    assert table.loc["radio.noise_dbm", ["symbol", "value", "unit", "origin"]].tolist() == [
        *["σ²", "-110.0", "dBm", "paper"]
    ]
    # The paper has 25 PRBs; this scenario has another number, which is not the paper's.
    assert table.loc["radio.num_prb", ["value", "origin", "default"]].tolist() == [
        *["4", "assumed", "25"]
    ]
    assert table["unit"].notna().all()
    assert table.loc["learners", "value"] == '{"alt": {"network": "mlp"}}'


def test_table_iii_of_short_runs_has_the_slots_that_there_are(
    tiny: Scenario, study: Study, planted: Callable[..., Study]
) -> None:
    slots = study.measures("slots")
    first = slots[slots["slot"].isna() | (slots["slot"] < 12)]
    assert rate_table(planted(tiny, measures=lambda _: first))["slot"].tolist() == [5, 10, "mean"]


def test_no_half_written_file_stays(written: Path) -> None:
    assert list(written.rglob("*.csv"))
    assert not list(written.rglob("*.part"))


@pytest.mark.parametrize(
    ("interval", "text"),
    [
        ((0.23124, 0.21, 0.25), "0.231 [0.210, 0.250]"),
        ((19.3456, 18.0, 20.7), "19.3 [18.0, 20.7]"),
        ((1234.5, 1000.0, 1469.0), "1234 [1000, 1469]"),
        ((2.0, 2.0, 2.0), "2 [±0]"),
        ((2e-9, 2e-9, 2e-9), "2e-09 [±0]"),
        ((0.0, 0.0, 1.13e-6), "< 1.1e-06"),
        ((0.0, 0.0, 0.0), "0 [±0]"),
        ((3.21e-7, 1.1e-7, 9.9e-7), "3.21e-07 [1.1e-07, 9.9e-07]"),
        ((0.0123, 0.00123, 0.5), "0.0123 [0.0012, 0.5]"),
        ((0.001, 0.0, 0.0124), "0.0010 [0.0000, 0.0124]"),
        ((-0.02, -0.05, 0.01), "-0.020 [-0.050, 0.010]"),
        ((453986741.0, 331470974.0, 576502508.0), "4.54e+08 [3.3e+08, 5.8e+08]"),
        ((9.713, 3.84, 212.0), "9.71 [3.8, 210]"),
        ((732909.0, 510814.0, 1051568.0), "733000 [510000, 1.1e+06]"),
        ((1.18, 0.77, math.inf), "1.18 [0.77, ∞)"),
        ((2e-7, 0.0, math.inf), "2e-07 [0, ∞)"),
        ((0.5, math.nan, math.nan), "0.5"),
        ((0.5, -math.inf, math.inf), "0.5 [unbounded]"),
        ((math.nan, math.nan, math.nan), "–"),
    ],
)
def test_digits_of_an_interval(interval: tuple[float, float, float], text: str) -> None:
    assert interval_text(*interval) == text


def test_markdown_merges_bounds_into_one_cell() -> None:
    frame = pd.DataFrame({"policy": ["a|b"], "x": [1.0], "x_lo": [0.5], "x_hi": [1.5]})
    lines = markdown_text(frame, "T", "N").splitlines()
    assert lines == [
        *["# T", "", "N", "", "| policy | x |", "|---|---:|"],
        "| a\\|b | 1.00 [0.50, 1.50] |",
    ]


def test_policies_say_how_they_stand_against_the_best_classical(
    tables: dict[str, pd.DataFrame],
) -> None:
    runs = tables["runs"]
    runs = runs[runs["axis"].isna()]
    backlog = {p: g["mean_square_backlog"].to_numpy() for p, g in runs.groupby("policy")}
    table = tables["policies"].set_index("policy")
    (best,) = set(table["best_classical"])
    assert best != "ddpg"
    assert backlog[best].mean() <= backlog["pf"].mean() * (1.0 + 1e-12)
    above = np.sign(backlog["ddpg"][:, None] - backlog[best][None, :])
    assert table.loc["ddpg", "improvement"] == pytest.approx(0.5 - 0.5 * above.mean())
    assert table.loc[best, "improvement"] == 0.5
    over = table.loc["ddpg", [f"backlog_over_best{end}" for end in ("", "_lo", "_hi")]]
    logarithms = np.log(crossed(tables, "ddpg", BACKLOG) / backlog[best])
    assert over.tolist() == pytest.approx(np.exp(crossed_t(logarithms)).tolist())
    assert table.loc[best, "backlog_over_best"] == 1.0
    against = tables["comparison"].query("baseline == @best and policy == 'ddpg'")
    assert len(against) == len(tables["comparison"].query("baseline == 'pf' and policy == 'ddpg'"))


def test_the_exact_optimum_is_no_scheduler_to_beat() -> None:
    rows = {"policy": ["exact", "pf", "ddpg"], "mean_square_backlog": [1.0, 3.0, 2.0]}
    assert best_classical(pd.DataFrame(rows)) == "pf"
    assert best_classical(pd.DataFrame({k: v[2:] for k, v in rows.items()})) is None


@pytest.fixture
def scores(tiny: Scenario, planted: Callable[..., Study]) -> Callable[..., pd.DataFrame]:
    """Scores of these backlogs by load and policy, one a world."""

    def table(sizes: dict[tuple[float, str], list[float]]) -> pd.DataFrame:
        rows = [
            {"axis": "load", "value": value, "policy": policy, "seed": seed, BACKLOG: size}
            for (value, policy), worlds in sizes.items()
            for seed, size in enumerate(worlds)
        ]
        runs = [pd.DataFrame(rows).assign(stage=stage) for stage in ("evaluate", "sweep")]
        return score_table(planted(tiny, runs=pd.concat(runs))).set_index("policy")

    return table


def test_scores_are_0_for_pf_and_1_for_the_best(scores: Callable[..., pd.DataFrame]) -> None:
    """By hand: log(64 / 4) / log(64 / 16) = 2, and as much at every load."""
    table = scores(
        {
            (value, policy): [size * value] * 3
            for value in (0.9, 1.0)
            for policy, size in (("pf", 64.0), ("edf", 16.0), ("ddpg", 4.0))
        }
    )
    assert table["score"].to_dict() == pytest.approx({"pf": 0.0, "edf": 1.0, "ddpg": 2.0})
    assert table["shorter_worlds"].to_dict() == {"pf": 0.0, "edf": 0.0, "ddpg": 1.0}
    assert (table["loads"] == 2).all()


def test_scores_are_of_worlds_and_loads_together(scores: Callable[..., pd.DataFrame]) -> None:
    """Where PF itself is the best, a load adds nothing to the scale; worlds are the units."""
    always = {
        (0.5, "pf"): [1.0, 1.0, 1.0],
        (0.5, "edf"): [2.0, 2.0, 2.0],
        (0.5, "ddpg"): [1.0, 2.0, 4.0],
    }
    sizes = {
        **always,
        (1.0, "pf"): [16.0, 16.0, 16.0],
        (1.0, "edf"): [4.0, 4.0, 4.0],
        (1.0, "ddpg"): [1.0, 2.0, 8.0],
    }
    row = scores(sizes).loc["ddpg"]
    # In doublings: PF / ddpg is 0 + 4, -1 + 3 and -2 + 1, PF / best is 0 + 2 in every world.
    expected = np.array([4.0, 2.0, -1.0]) / 2.0
    bounds = stats.ttest_1samp(expected, 0.0).confidence_interval(0.95)
    bounds = [expected.mean(), bounds.low, bounds.high]
    assert row[["score", "score_lo", "score_hi"]].tolist() == pytest.approx(bounds)
    assert row["shorter_worlds"] == pytest.approx(2 / 6)
    assert scores(always)["score"].isna().all()  # no scheduler beats PF anywhere


def test_generalisation_is_paired_with_the_best_scheduler_there(
    tables: dict[str, pd.DataFrame],
) -> None:
    table = tables["generalisation"]
    assert list(dict.fromkeys(table["axis"])) == ["cell", "load", "rayleigh_scale"]
    assert set(table[table["axis"] == "cell"]["value"]) == {"u2_e1_k4", "u2_e1_k6"}
    own = table[table["policy"] == table["best_classical"]]
    assert (own["backlog_over_best"] == 1.0).all()
    rows = tables["runs"].query("axis == 'cell' and value == 'u2_e1_k6'")
    row = table.query("value == 'u2_e1_k6' and policy == 'ddpg'").iloc[0]
    own = rows[rows["policy"] == "ddpg"].pivot(index="policy_seed", columns="seed", values=BACKLOG)
    best = rows[rows["policy"] == row["best_classical"]][BACKLOG].to_numpy()
    bounds = [row["backlog_over_best_lo"], row["backlog_over_best_hi"]]
    assert bounds == pytest.approx(np.exp(crossed_t(np.log(own.to_numpy() / best))[1:]).tolist())


def test_bound_table_has_the_planted_gaps(tables: dict[str, pd.DataFrame]) -> None:
    table = tables["bound"].set_index(["states_of", "decider"])
    greedy = table.loc[("drift_plus_penalty", "drift_plus_penalty")]
    assert greedy["gap"] == pytest.approx(1.0)
    low, high = stats.ttest_1samp([0.0, 1.0, 2.0], 0.0).confidence_interval(0.95)
    assert [greedy["gap_lo"], greedy["gap_hi"]] == pytest.approx([low, high])
    assert greedy["share_optimal"] == pytest.approx(1 / 3)
    assert greedy["uncertified"] == pytest.approx(0.001)
    assert greedy["first_gap"] == pytest.approx(2.0)
    assert greedy["first_log_rate_gap"] == pytest.approx(0.5)
    assert table.loc[("pf", "pf"), "gap_share"] == pytest.approx(2.0)
    assert len(table) == 2 + 2 + 4 + 2
