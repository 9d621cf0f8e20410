from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from hiersched.scenario import Scenario
from hiersched.study.built_in import shown
from hiersched.study.claims.report import (
    BEGIN,
    END,
    claim_json,
    claims_markdown,
    insert_table,
    join_claims,
)
from hiersched.study.claims.verdicts import (
    Condition,
    Judged,
    Outcome,
    Statement,
    Verdict,
)
from hiersched.study.registry import CLAIMS
from hiersched.study.statistics import Interval, halvings, mean_interval
from hiersched.study.study import Study


def statement(lo: float, hi: float, **claimed: float) -> Statement:
    interval = Interval(0.5 * (lo + hi), lo, hi)
    values = (interval.mean,) * 5
    return Statement(name="x", unit="1", interval=interval, effect=1.0, values=values, **claimed)


@pytest.mark.parametrize(
    ("lo", "hi", "claimed", "outcome"),
    [
        (0.1, 0.4, {"above": 0.0}, "holds"),
        (-0.1, 0.4, {"above": 0.0}, "open"),
        (-0.4, -0.1, {"above": 0.0}, "contradicted"),
        (1.0, 1.0, {"below": 1.0}, "contradicted"),
        (0.96, 1.04, {"above": 0.95, "below": 1.05}, "holds"),
        (0.94, 1.04, {"above": 0.95, "below": 1.05}, "open"),
        (1.06, 1.08, {"above": 0.95, "below": 1.05}, "contradicted"),
        (-math.inf, 0.3, {"below": 0.5}, "open"),
        (math.nan, math.nan, {"below": 0.5}, "open"),
    ],
)
def test_a_statement_holds_by_its_whole_interval(
    lo: float, hi: float, claimed: dict[str, float], outcome: Outcome
) -> None:
    assert statement(lo, hi, **claimed).outcome == outcome


def condition(*outcomes: str, axis: str = "load", counts: bool = True) -> Condition:
    bounds = {"holds": (0.1, 0.4), "open": (-0.1, 0.4), "contradicted": (-0.4, -0.1)}
    statements = tuple(statement(*bounds[outcome], above=0.0) for outcome in outcomes)
    return Condition(axis=axis, value="1", policy="ddpg", statements=statements, counts=counts)


@pytest.mark.parametrize(
    ("outcomes", "outcome"),
    [
        (("holds", "holds"), "holds"),
        (("holds", "open"), "open"),
        (("open", "contradicted"), "contradicted"),
        ((), "open"),
    ],
)
def test_a_condition_needs_all_its_statements(outcomes: tuple[str, ...], outcome: Outcome) -> None:
    assert condition(*outcomes).outcome == outcome


@pytest.mark.parametrize(
    ("base", "others", "verdict", "flips"),
    [
        (["holds"], ["holds", "open"], "reproduced", 0),
        (["holds"], ["holds", "contradicted"], "depends", 1),
        (["open"], ["open", "contradicted"], "not reproduced", 0),
        (["contradicted"], ["holds", "holds"], "depends", 2),
        (["contradicted"], [], "not reproduced", 0),
        ([], ["holds"], "not judged", 1),
    ],
)
def test_the_rule(base: list[str], others: list[str], verdict: str, flips: int) -> None:
    first, rest = condition(*base, axis=""), [condition(outcome) for outcome in others]
    judged = Judged(first, tuple(rest))
    assert (judged.verdict, len(judged.flipped_by)) == (verdict, flips)
    # What is shown for comparison changes nothing.
    shown = [condition("contradicted", counts=False), condition("holds", counts=False)]
    judged = Judged(first, (*rest, *shown))
    assert (judged.verdict, len(judged.flipped_by)) == (verdict, flips)


def of_seeds(*values: float, **claimed: float) -> Statement:
    interval = mean_interval(values)
    return Statement(name="x", unit="1", interval=interval, effect=1.0, values=values, **claimed)


def test_a_verdict_stands_where_halves_of_the_seeds_agree() -> None:
    """Ten seeds: 126 halvings. Nine at 1 and one at -5 that turns every half it is in: none agree.

    With -3 instead, halves of the outlier have the mean 0.2: all agree. Of four seeds of 1 and two
    of -0.9 among them, a half of two and one has 1.1 / 3, one of one and two -0.8 / 3.
    """

    def claim(*statements: Statement) -> Condition:
        return Condition(axis="", value="", policy="ddpg", statements=statements)

    assert len(halvings(10)) == 126
    one, other = [1.0] * 9 + [-5.0], [1.0] * 9 + [-3.0]
    assert claim(of_seeds(*one, above=0.0)).agreement == 0.0
    assert claim(of_seeds(*other, above=0.0)).agreement == 1.0
    mixed = claim(of_seeds(1.0, 1.0, 1.0, 1.0, -0.9, -0.9, above=0.0))
    # The two lie in one half in 4 of the 10 ways.
    assert mixed.agreement == pytest.approx(6 / 10)
    assert claim(of_seeds(*other, above=0.0), of_seeds(*one, above=0.0)).agreement == 0.0
    assert math.isnan(claim(of_seeds(1.0, above=0.0)).agreement)
    assert math.isnan(claim(of_seeds(1.0, 2.0), of_seeds(1.0, 2.0, 3.0)).agreement)
    held = claim(of_seeds(*[1.0 + 0.01 * i for i in range(9)], 1.5, above=0.0))
    assert Judged(held, ()).verdict == "reproduced"
    few = of_seeds(3.0, *[0.02, 0.03, 0.02, 0.04, 0.02, 0.03, 0.02, 0.02], 0.01, above=0.1)
    assert few.outcome == "open"
    assert Judged(claim(few), ()).verdict == "depends"  # without halvings: not reproduced


def test_training_seeds_are_halved_with_all_worlds() -> None:
    """Four policies in three worlds: by policies 1, 1, 1, -2.7; by worlds alone all agree.

    Of three halvings each puts the outlier beside another, and their mean is below 0.
    """
    table = np.full((4, 3), 1.0)
    table[3] = -2.7
    rows = tuple(tuple(row) for row in table.tolist())
    by_policy = Statement(
        name="x", unit="1", interval=Interval(0.1, 0.1, 0.1), effect=1.0, values=rows, above=0.0
    )
    assert by_policy.count == 4
    assert by_policy.claimed_by(np.arange(4))
    assert by_policy.claimed_by(np.array([0, 1]))
    assert not by_policy.claimed_by(np.array([2, 3]))
    condition = Condition(axis="", value="", policy="ddpg", statements=(by_policy,))
    assert condition.agreement == 0.0
    by_world = replace(by_policy, values=tuple(zip(*rows, strict=True)))
    assert replace(condition, statements=(by_world,)).agreement == 1.0


def test_halves_of_ratios_are_of_logarithms() -> None:
    ratio = Statement(
        name="x",
        unit="1",
        interval=Interval(0.5, 0.4, 0.6),
        effect=1.0,
        values=tuple(np.log([0.5, 0.25, 1.0])),
        logarithms=True,
        below=0.6,
    )
    assert ratio.claimed_by(np.array([0, 1]))
    assert not ratio.claimed_by(np.array([0, 2]))  # the geometric mean is 0.71


SEEDS = (1, 2, 3, 4, 5)
SCALES = (0.5, 1.0, 2.0)


def planted(measure: str, policy: str, axis: str, value: str, seed: int) -> float:
    """Known numbers: what differs between policies, along axes, and a little by seed."""
    own = policy == "ddpg"
    doublings = math.log2(float(value)) if axis == "rayleigh_scale" else 0.0
    load = float(value) if axis == "load" else 0.9
    numbers = {
        "urllc_rate_mbps": (19.0 if own else 20.0) + doublings,
        "embb_rate_mbps": 21.0 + doublings - (4.0 if load == 1.0 and own else 0.0),
        "urllc_backlog_packets": 4.0 - 2.0 * doublings,
        "embb_backlog_packets": 9.0 - doublings,
        "urllc_late_share": 0.01 if own else 0.2,
        "dexterity_index": {"zigzag": 0.66, "arc": 0.91}.get(value, 0.75),
    }
    if axis == "service_coefficient_mbps" and value == "8_0.05":
        numbers["urllc_rate_mbps"] *= 0.9
    if axis == "load_ratio" and value == "0.7":
        numbers["embb_rate_mbps"] -= 5.0
    if axis == "reference":
        numbers["urllc_rate_mbps"] -= 4.0 * (numbers["dexterity_index"] - 0.75)
        numbers["embb_rate_mbps"] += 4.0 * (numbers["dexterity_index"] - 0.75)
    return numbers[measure] * (1.0 + 1e-3 * (seed - 3))


def runs_of(axis: str, values: tuple[str, ...]) -> pd.DataFrame:
    names = "urllc_rate_mbps embb_rate_mbps urllc_backlog_packets embb_backlog_packets"
    rows = [
        {
            "stage": "sweep" if axis else "evaluate",
            "policy": policy,
            "seed": seed,
            "axis": axis,
            "value": value,
            "num_slots": 100,
            "urllc_due_packets": 4000,
            **{
                name: planted(name, policy, axis, value, seed)
                for name in (*names.split(), "urllc_late_share", "dexterity_index")
            },
        }
        for policy in ("ddpg", "pf")
        for value in values
        for seed in SEEDS
    ]
    return pd.DataFrame(rows)


@pytest.fixture(scope="module")
def episodes() -> dict[str, dict[str, pd.DataFrame]]:
    """Training and checkpoints of a learner and of a control that learns nothing."""
    rounds = np.arange(10)
    curve = {"urllc_reward": -np.exp(-rounds), "embb_reward": -0.1 * rounds}
    training = pd.concat(
        pd.DataFrame(
            {
                "seed": seed,
                "episode": rounds + 1,
                "urllc_backlog_packets": 30.0 - 2.0 * rounds + seed,
                "embb_backlog_packets": 30.0 - rounds + seed,
                **{name: values * (1.0 + 0.01 * seed) for name, values in curve.items()},
            }
        )
        for seed in SEEDS
    )
    checkpoints = training[training["episode"].isin([1, 4, 7, 10])]
    idle = checkpoints.assign(
        **{name: checkpoints["seed"] * 1.0 for name in checkpoints if name.endswith("packets")},
        urllc_reward=-0.5,
        embb_reward=-0.5,
    )
    noisy = training.assign(urllc_reward=-0.5 + 0.02 * training["episode"])
    return {
        "training": {"ddpg": training, "idle": noisy},
        "checkpoints": {"ddpg": checkpoints, "idle": idle},
    }


@pytest.fixture(scope="module")
def runs() -> pd.DataFrame:
    axes: dict[str, tuple[str, ...]] = {
        "": ("",),
        "rayleigh_scale": tuple(map(str, SCALES)),
        "sampling_s": ("0.02", "0.05"),
        "reference": ("zigzag", "arc"),
        "load": ("0.85", "1.0"),
        "load_ratio": ("0.7", "1.4"),
        "service_coefficient_mbps": ("0_0.02", "0_0.05", "8_0.02", "8_0.05"),
    }
    frames = [runs_of(axis, values) for axis, values in axes.items()]
    return pd.concat(frames, ignore_index=True)


@pytest.fixture(scope="module")
def scenario(tiny: Scenario) -> Scenario:
    learning = replace(tiny.learning, num_envs=1, seeds=SEEDS)
    return replace(
        tiny,
        evaluate=replace(tiny.evaluate, policies=("ddpg", "pf")),
        learning=learning,
        learners={"idle": replace(learning, frozen=True)},
    )


Judge = Callable[..., dict[int, Judged]]


@pytest.fixture(scope="module")
def judge(
    scenario: Scenario,
    runs: pd.DataFrame,
    episodes: dict[str, dict[str, pd.DataFrame]],
    planted: Callable[..., Study],
) -> Judge:
    """Judge the claims by the planted numbers, or others; the gain study's are in its logs."""

    def judged(**other: object) -> dict[int, Judged]:
        study = planted(scenario, **{"runs": runs, **episodes, **other})
        found = shown(CLAIMS, scenario).items()
        return {int(name.removeprefix("claim")): claim.build(study) for name, claim in found}

    return judged


@pytest.fixture(scope="module")
def claims(judge: Judge) -> dict[int, Judged]:
    return judge()


def test_verdicts_follow_from_planted_numbers(claims: dict[int, Judged]) -> None:
    verdicts = {number: claim.verdict for number, claim in claims.items()}
    assert verdicts == {
        1: "not reproduced",  # the eMBB reward falls
        2: "reproduced",
        3: "depends",  # at load 1 it is the other way round, and with less eMBB load
        4: "reproduced",
        5: "not reproduced",  # both queues fall
        6: "depends",  # with a larger beta
        7: "not reproduced",  # the eMBB rate rises with the index
        8: "depends",  # other methods do not help
        9: "reproduced",
        10: "reproduced",
    }
    assert [c.value for c in claims[3].flipped_by] == ["1.0", "0.7"]
    assert [(c.axis, c.value) for c in claims[6].flipped_by] == [
        ("traffic.service_coefficient_mbps", "8")
    ]
    assert [c.outcome for c in claims[6].others if c.value == "0"] == ["holds"]
    assert [c.value for c in claims[8].flipped_by] == ["razumikhin, split", "predictor, network"]


def test_numbers_are_those_of_the_planted_runs(claims: dict[int, Judged]) -> None:
    (difference,) = claims[3].base.statements
    expected = 2.0 * (1.0 + 1e-3 * (np.array(SEEDS) - 3))
    bounds = stats.ttest_1samp(expected, 0.0).confidence_interval(0.95)
    assert difference.interval == pytest.approx((2.0, bounds.low, bounds.high))
    assert claims[4].base.statements[0].interval.mean == pytest.approx(1.0)
    assert claims[5].base.statements[0].interval.mean == pytest.approx(-1.0)
    assert claims[5].base.statements[1].interval.mean == pytest.approx(2.0 / 6.0)
    assert claims[7].base.statements[0].interval.mean == pytest.approx(-0.4)
    assert claims[8].base.statements[0].interval.mean == pytest.approx(
        stats.gmean([0.49, 0.50, 0.51])
    )
    assert claims[9].base.statements[0].interval.mean == pytest.approx(0.95)
    assert claims[10].base.statements[0].interval.mean == pytest.approx(0.05)


def test_rewards_and_queues_are_judged_without_noise_beside_a_control(
    claims: dict[int, Judged],
) -> None:
    """Queues at episodes 1, 4, 7 and 10: 18 packets less; those of the control stay."""
    fall, beyond, *_ = claims[2].base.statements
    assert fall.interval.mean == beyond.interval.mean == pytest.approx(-18.0)
    late = claims[1].base.statements[1]
    size = 1.0 + 0.01 * np.array(SEEDS)
    rise, step = (1.0 - math.exp(-9)) * size, (math.exp(-6) - math.exp(-9)) * size
    assert late.interval.mean == pytest.approx((step - 0.1 * rise).mean())
    assert late.name.endswith("last step − 10 % of that")
    shown = {(c.axis, c.policy): c for c in claims[1].others if not c.counts}
    assert set(shown) == {
        ("learns nothing", "idle"),
        ("with noise", "ddpg"),
        ("learns nothing, with noise", "idle"),
    }
    # What the control seems to learn under the noise: two of ten rounds a fifth, 0.02 a round.
    (rise, _) = shown["learns nothing, with noise", "idle"].statements
    assert rise.interval.mean == pytest.approx(8 * 0.02)
    assert rise.outcome == "holds"
    still = shown["learns nothing", "idle"].statements[0]
    assert still.interval.mean == 0.0
    assert still.outcome == "contradicted"


def test_a_learner_that_does_what_its_control_does_shows_nothing(
    judge: Judge, episodes: dict[str, dict[str, pd.DataFrame]]
) -> None:
    own = episodes["checkpoints"]["ddpg"]
    claims = judge(checkpoints={"ddpg": own, "idle": own})
    assert {claims[number].base.outcome for number in (1, 2)} == {"contradicted"}


def test_what_was_not_run_is_not_judged(judge: Judge, runs: pd.DataFrame) -> None:
    kept = (runs["stage"] == "evaluate") & (runs["policy"] == "pf")
    kept |= (runs["stage"] == "sweep") & runs["value"].isin(["0.5", "zigzag"])
    verdicts = {number: claim.verdict for number, claim in judge(runs=runs[kept]).items()}
    assert {n for n, v in verdicts.items() if v == "not judged"} == {3, 4, 5, 6, 7, 9, 10}


# What is written.


@pytest.fixture(scope="module")
def joined(written: Path, tiny: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The claims of the tiny study, put together."""
    folder: Path = tmp_path_factory.mktemp("joined")
    shutil.copytree(written / "claims", folder / "claims")
    join_claims(tiny, folder, list(shown(CLAIMS, tiny)))
    return folder


def test_claims_are_joined_as_they_were_judged(joined: Path, tiny: Scenario) -> None:
    document = json.loads((joined / "claims.json").read_text())
    assert (document["scenario"], document["level"]) == ("tiny", 0.95)
    assert [claim["number"] for claim in document["claims"]] == list(range(1, 11))
    for claim in document["claims"]:
        path = joined / f"claims/claim{claim['number']}.json"
        assert claim == json.loads(path.read_text())


def test_claims_stand_in_the_papers_order(joined: Path, tiny: Scenario, tmp_path: Path) -> None:
    shutil.copytree(joined / "claims", tmp_path / "claims")
    join_claims(tiny, tmp_path, ["claim10", "claim3"])
    claims = json.loads((tmp_path / "claims.json").read_text())["claims"]
    assert [claim["number"] for claim in claims] == [3, 10]


def test_both_files_say_the_same(joined: Path, tables: dict[str, pd.DataFrame]) -> None:
    claims = json.loads((joined / "claims.json").read_text())["claims"]
    verdicts, sensitivity = (joined / "claims.md").read_text().split("## Sensitivity")
    assert len([line for line in verdicts.splitlines() if line.startswith("|")]) == 12
    for claim in claims:
        (row,) = [line for line in verdicts.splitlines() if f"({claim['reference']})" in line]
        assert f"**{claim['verdict']}**" in row
        assert claim["claim"] in row
        assert claim["measured"] in row
        for statement in claim["base"]["statements"]:
            assert statement["text"] in row
        rows = [x for x in sensitivity.splitlines() if x.startswith(f"| {claim['number']} |")]
        assert len(rows) == 1 + len(claim["sensitivity"]) + len(claim["beside"])
        outcomes = [line.split("|")[4].strip() for line in rows]
        counted = [claim["base"], *claim["sensitivity"]]
        assert outcomes[: len(counted)] == [c["outcome"] for c in counted]
        assert outcomes[len(counted) :] == [f"({c['outcome']})" for c in claim["beside"]]
    rate = claims[8]["base"]["statements"][0]
    runs = tables["runs"]
    by_world = runs[runs["stage"] == "evaluate"].set_index(["policy", "seed"])["urllc_rate_mbps"]
    logs = np.log(by_world["ddpg"] / by_world["pf"])
    assert len(logs) == 2 * 3  # two policies in three worlds each
    assert rate["estimate"] == pytest.approx(np.exp(logs.mean()))
    assert rate["seeds"] == 2
    assert 0.0 <= claims[8]["halvings_that_agree"] <= 1.0
    loads = [run["value"] for run in claims[9]["sensitivity"] if run["axis"] == "traffic.load"]
    assert loads == ["0.85", "1.0"]


def test_bounds_that_are_not_finite_are_null() -> None:
    unbounded = statement(0.1, math.inf, below=0.5)
    condition = Condition(axis="", value="", policy="ddpg", statements=(unbounded,))
    (written,) = claim_json(CLAIMS["claim10"], Judged(condition, ()))["base"]["statements"]
    assert (written["lo"], written["hi"]) == (0.1, None)
    assert (written["claimed_above"], written["claimed_below"]) == (None, 0.5)


def test_what_flips_a_claim_is_named(claims: dict[int, Judged], scenario: Scenario) -> None:
    document = claim_json(CLAIMS["claim3"], claims[3])
    assert document["flipped_by"] == ["traffic.load = 1.0", "traffic.load_ratio = 0.7"]
    text = claims_markdown([document], scenario)
    (row,) = [line for line in text.splitlines() if "(Fig. 4)" in line]
    assert "**depends** | 100 % | traffic.load = 1.0; traffic.load_ratio = 0.7 |" in row


def test_the_readme_gets_its_table_from_the_file(claims: dict[int, Judged]) -> None:
    documents = [claim_json(CLAIMS[f"claim{number}"], own) for number, own in claims.items()]
    document = json.dumps({"claims": documents})
    text = insert_table(f"before\n{BEGIN}\nold\n{END}\nafter\n", document)
    assert text.startswith(f"before\n{BEGIN}\n| ")
    assert text.endswith(f"\n{END}\nafter\n")
    assert "old" not in text
    assert insert_table(text, document) == text
    rows = {line.split("|")[1].strip(): line for line in text.splitlines() if "|" in line}
    assert rows["3"].endswith(
        "(Fig. 4) | eMBB rate − URLLC rate: 2.0000 [1.9961, 2.0039] Mbit/s | **depends** |"
    )
    first, second, *_ = documents[1]["base"]["statements"]
    assert first["text"] in rows["2"]
    assert second["name"] not in rows["2"]
    with pytest.raises(ValueError, match="claims: begin"):
        insert_table("no marks", document)


def test_the_readme_has_a_verdict_on_every_claim(project_root: Path) -> None:
    table = (project_root / "README.md").read_text(encoding="utf-8").split(BEGIN)[1].split(END)[0]
    rows = [line for line in table.splitlines() if line.startswith("| ")][1:]
    assert [row.split("|")[1].strip() for row in rows] == [str(n) for n in range(1, 11)]
    assert all(row.split("**")[1] in get_args(Verdict) for row in rows)
