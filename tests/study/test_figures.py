from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Annotation

from hiersched.log import LogReader
from hiersched.policies.registry import RULES
from hiersched.scenario import Scenario
from hiersched.study.built_in import shown
from hiersched.study.figures.comparison import (
    delay_tails,
    draw_load,
    draw_pareto,
    draw_violations,
    pareto_front,
)
from hiersched.study.figures.gains import draw_gain
from hiersched.study.figures.rates import draw_dexterity, draw_rayleigh
from hiersched.study.figures.style import (
    arrows_text,
    draw_series,
    house_style,
    log_axis_with_zero,
    policy_look,
    save_figure,
    zero_floor,
)
from hiersched.study.figures.training import training_curve
from hiersched.study.registry import FIGURES, Shown
from hiersched.study.study import Study

Planted = Callable[..., Study]


@pytest.fixture(scope="module")
def figures(with_sources: Callable[[Shown], Path], tiny: Scenario) -> dict[str, Figure]:
    """All of them, each of the files alone that it says it reads, laid out."""
    drawn = {}
    with house_style():
        for name, thing in shown(FIGURES, tiny).items():
            drawn[name] = thing.build(Study(tiny, with_sources(thing)))
            drawn[name].draw_without_rendering()
    return drawn


@pytest.fixture(scope="module")
def sweeps(tables: dict[str, pd.DataFrame]) -> pd.DataFrame:
    return tables["sweeps"]


def bars(axes: Axes) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Drawn means (x, y) and ends of the error bars (n, lo and hi) by label."""
    drawn = {}
    for container in axes.containers:
        line, _, (stems, *_) = container.lines
        if line is None:  # bars alone
            continue
        ends = np.array([segment[:, 1] for segment in stems.get_segments()])
        drawn[container.get_label()] = (np.array(line.get_data()), ends)
    return drawn


def assert_drawn(axes: Axes, label: str, rows: pd.DataFrame, measure: str) -> None:
    points, ends = bars(axes)[label]
    assert points[1] == pytest.approx(rows[measure].to_numpy())
    lo, mean, hi = (rows[f"{measure}{end}"].to_numpy() for end in ("_lo", "", "_hi"))
    bounded = np.isfinite(hi)
    assert ends == pytest.approx(np.column_stack([lo, np.where(bounded, hi, mean)]))
    arrows = [text for text in axes.texts if isinstance(text, Annotation) and text.arrow_patch]
    assert set(zip(*points[:, ~bounded], strict=True)) <= {arrow.xyann for arrow in arrows}


def test_equal_figures_have_equal_bytes(study: Study, written: Path, tmp_path: Path) -> None:
    names = {path.stem for path in (written / "figures").iterdir()}
    assert names
    for name in names:
        with house_style():
            again = save_figure(FIGURES[name].build(study), tmp_path, name)
        svg, png = [path.read_bytes() for path in again]
        assert svg == (written / f"figures/{name}.svg").read_bytes()
        assert png == (written / f"figures/{name}.png").read_bytes()
        assert b"<dc:date>" not in svg
        assert png[:8] == b"\x89PNG\r\n\x1a\n"


DOTS = ("figX_gain_cells",)
"""Figures whose rows are named."""


def test_every_panel_has_title_units_and_data(figures: dict[str, Figure]) -> None:
    for name, figure in figures.items():
        for axes in figure.axes:
            if axes.get_label() == "<colorbar>":
                continue
            assert axes.has_data(), name
            assert axes.get_title(loc="left"), name
            inner = not axes.xaxis.get_tick_params()["labelbottom"]  # the panel below has it
            assert axes.get_xlabel() or inner, name
    unlabelled = {"fig4_rate_cdf", "fig8_violations", "figX_delay", "figX_bound", *DOTS}
    for name in set(figures) - unlabelled:
        panels = [axes for axes in figures[name].axes if axes.get_label() != "<colorbar>"]
        assert all("[" in axes.get_ylabel() for axes in panels), name


@pytest.mark.parametrize(
    ("figure", "panel", "axis", "measure"),
    [
        ("fig6_sampling", 0, "sampling_s", "embb_rate_mbps"),
        ("fig6_sampling", 1, "sampling_s", "urllc_rate_mbps"),
        ("figX_load", 1, "load", "tracking_error_cm"),
    ],
)
def test_sweep_figures_show_the_table(
    figures: dict[str, Figure],
    sweeps: pd.DataFrame,
    figure: str,
    panel: int,
    axis: str,
    measure: str,
) -> None:
    axes = figures[figure].axes[panel]
    for policy in ("ddpg", "pf"):
        rows = sweeps[(sweeps["axis"] == axis) & (sweeps["policy"] == policy)]
        assert_drawn(axes, policy_look(policy).label, rows, measure)
    if axis == "sampling_s":
        assert bars(axes)["PF"][0][0] == pytest.approx([20.0, 50.0])


def test_rayleigh_figure_shows_the_table_and_the_papers_rates(
    figures: dict[str, Figure], sweeps: pd.DataFrame
) -> None:
    rates, queues = figures["fig5_rayleigh"].axes
    for policy, label in (("ddpg", "DRL (DDPG)"), ("pf", "PF")):
        rows = sweeps[(sweeps["axis"] == "rayleigh_scale") & (sweeps["policy"] == policy)]
        for part, name in (("urllc", "URLLC"), ("embb", "eMBB")):
            assert_drawn(rates, f"{name}, {label}", rows, f"{part}_rate_mbps")
            points = bars(queues)[f"{name}, {label}"][0]
            assert points[1] == pytest.approx(rows[f"{part}_backlog_packets"].to_numpy())
    stars = {line.get_label(): line.get_ydata()[0] for line in rates.get_lines()}
    assert stars["paper, URLLC, DRL"] == pytest.approx((17.9188 + 19.6458 + 19.7586) / 3)
    assert stars["paper, URLLC, PF"] == pytest.approx((19.4697 + 19.2875 + 19.9794) / 3)


def test_dexterity_figure_has_the_measured_index_below(
    figures: dict[str, Figure], sweeps: pd.DataFrame
) -> None:
    rows = sweeps[(sweeps["axis"] == "reference") & (sweeps["policy"] == "pf")]
    rows = rows.sort_values("dexterity_index")
    points = bars(figures["fig7_dexterity"].axes[1])["PF"][0]
    assert points[0] == pytest.approx(rows["dexterity_index"].to_numpy())
    assert points[1] == pytest.approx(rows["urllc_rate_mbps"].to_numpy())


def test_violation_figure_shows_the_table_and_the_allowed_share(
    figures: dict[str, Figure], tables: dict[str, pd.DataFrame], tiny: Scenario
) -> None:
    axes = figures["fig8_violations"].axes[0]
    table = tables["policies"].set_index("policy")
    rows = dict(zip([t.get_text() for t in axes.get_yticklabels()], axes.get_yticks(), strict=True))
    drawn = {}
    for container in axes.containers:
        (x,), (y,) = container.lines[0].get_data()
        drawn[y] = x
    floor = axes.get_xticks()[0]
    for policy in tiny.evaluate.policies:
        share = table.loc[policy, "urllc_late_share"]
        assert drawn[rows[policy_look(policy, tiny).label]] == pytest.approx(max(share, floor))
    verticals = [line.get_xdata()[0] for line in axes.get_lines()]
    assert any(x == pytest.approx(0.05) for x in verticals)


def test_gain_figure_shows_the_table_and_the_papers_ratios(
    figures: dict[str, Figure], tables: dict[str, pd.DataFrame]
) -> None:
    table = tables["table2_methods"]
    errors, ratios = figures["figX_gain"].axes
    assert_drawn(errors, "nominal gain", table[table["method"] == "krasovskii"], "nominal_cm")
    violated = table[table["violated"]]
    for method, label in (
        ("krasovskii", "Krasovskii"),
        ("razumikhin", "Razumikhin, split plant"),
        ("predictor", "predictor"),
    ):
        assert_drawn(ratios, label, violated[violated["method"] == method], "ratio")
    (paper,) = [line for line in ratios.get_lines() if line.get_label() == "paper"]
    assert paper.get_ydata() == pytest.approx([0.78967, 0.71207, 0.64864], abs=1e-5)


def small_print(figure: Figure) -> str:
    """The caption on one line."""
    return figure.get_supxlabel().replace("\n", " ").replace("\u00a0", " ")


def with_late_share(runs: pd.DataFrame, own: float) -> pd.DataFrame:
    """Runs in which the learned policy has this late share and all others 0.2."""
    return runs.assign(urllc_late_share=np.where(runs["policy"] == "ddpg", own, 0.2))


@pytest.mark.parametrize("none_late", [True, False])
@pytest.mark.parametrize("draw", [draw_violations, draw_load])
def test_captions_speak_of_open_marks_only_where_there_are_some(
    study: Study, planted: Planted, none_late: bool, draw: Callable[[Study], Figure]
) -> None:
    runs = with_late_share(study.runs, 0.0 if none_late else 0.01)
    with house_style():
        text = small_print(draw(planted(study.scenario, runs=runs)))
    assert ("Open mark at 0" in text) == none_late
    assert "dotted line" in text


def test_the_upper_bound_of_a_share_of_0_is_drawn(study: Study, planted: Planted) -> None:
    runs = with_late_share(study.runs, 0.0)
    with house_style():
        panel = draw_load(planted(study.scenario, runs=runs)).axes[0]
    (_, y), ends = bars(panel)["DRL (DDPG)"]
    # Of two policies: 1 - 0.05^(1/2) of a batch of 4 of all due packets.
    own = runs[(runs["axis"] == "load") & (runs["policy"] == "ddpg")]
    due = own.groupby("value", sort=False)["urllc_due_packets"].min()
    bounds = (1.0 - 0.05**0.5) * 4.0 / due.to_numpy()
    assert (y < bounds).all()
    assert ends[:, 1] == pytest.approx(bounds)


def test_load_figure_has_every_policy_of_the_table(
    figures: dict[str, Figure], sweeps: pd.DataFrame
) -> None:
    rows = sweeps[(sweeps["axis"] == "load") & (sweeps["policy"] == "drift_plus_penalty")]
    axes = figures["figX_load"].axes
    for panel in axes:
        assert list(bars(panel)) == ["DRL (DDPG)", "PF", "drift-plus-penalty"]
    assert_drawn(axes[2], "drift-plus-penalty", rows, "mean_square_backlog")
    assert_drawn(axes[3], "drift-plus-penalty", rows, "embb_rate_mbps")


def test_tails_are_of_every_policy_and_end_at_one_in_ten_thousand(
    figures: dict[str, Figure], study: Study
) -> None:
    tails = delay_tails(study)
    assert list(dict.fromkeys(tails["policy"])) == list(study.scenario.evaluate.policies)
    left, right = figures["figX_delay"].axes
    assert right.get_ylim()[0] == 1e-4
    (line,) = [line for line in right.get_lines() if line.get_label() == "PF"]
    own = tails[tails["policy"] == "pf"]
    assert line.get_ydata()[:20] == pytest.approx(own["share"].to_numpy()[:20])
    assert len(left.collections) == 2  # bands of those that the sweeps compare


def test_pareto_front_is_what_no_other_beats(
    figures: dict[str, Figure], tables: dict[str, pd.DataFrame]
) -> None:
    frame = pd.DataFrame({"less": [3, 1, 2, 2, 4], "more": [5, 1, 4, 3, 5], "name": list("abcde")})
    assert list(pareto_front(frame, "less", "more")["name"]) == ["b", "c", "a"]
    table = tables["policies"].set_index("policy")
    (points, _) = bars(figures["figX_pareto"].axes[1])["PF"]
    assert points[:, 0] == pytest.approx(table.loc["pf", ["tracking_error_cm", "embb_rate_mbps"]])


def test_bound_figure_shows_the_table(
    figures: dict[str, Figure], tables: dict[str, pd.DataFrame]
) -> None:
    table = tables["bound"]
    own = table[table["states_of"] == table["decider"]].set_index("decider")
    left, right = figures["figX_bound"].axes
    names = [text.get_text() for text in left.get_yticklabels()]
    assert names == ["PF", "alt", "DRL (DDPG)", "drift-plus-penalty"]
    means = {c.lines[0].get_ydata()[0]: c.lines[0].get_xdata()[0] for c in left.containers}
    assert means[0] == pytest.approx(own.loc["pf", "gap"]) == 200.0
    assert means[1] == pytest.approx(60.0)
    assert means[2] == pytest.approx(50.0)
    assert len(right.containers) == 4


def test_cells_figure_shows_the_table(
    figures: dict[str, Figure], tables: dict[str, pd.DataFrame]
) -> None:
    axes = figures["figX_generalise"].axes[1]
    rows = tables["generalisation"].query("axis == 'cell' and policy == 'ddpg'")
    assert_drawn(axes, "DRL (DDPG)", rows, "mean_square_backlog")
    labels = [text.get_text() for text in axes.get_xticklabels()]
    assert labels == ["2 + 1\n4 PRBs", "2 + 1\n6 PRBs"]


@pytest.mark.parametrize(
    ("rates", "text"),
    [
        ((20.0, 21.0, 22.0), "DRL rises by 9.5 % with DI"),
        ((22.0, 21.0, 20.0), "DRL falls by 9.5 % with DI"),
        ((20.0, 22.0, 21.0), "DRL not monotone in DI (9.5 %)"),
        ((20.0, 20.01, 20.0), "DRL flat over DI"),
    ],
)
def test_dexterity_title_says_which_way_the_rate_goes(
    study: Study, planted: Planted, rates: tuple[float, ...], text: str
) -> None:
    """Listed against the order of the index: the order of the rows must not matter."""
    own = study.runs[(study.runs["axis"] == "reference") & (study.runs["policy"] == "ddpg")]
    first = own[own["value"] == "zigzag"]
    runs = [
        first.assign(value=name, dexterity_index=index, urllc_rate_mbps=rate)
        for name, index, rate in zip("cba", (0.9, 0.8, 0.7), rates[::-1], strict=True)
    ]
    with house_style():
        figure = draw_dexterity(planted(study.scenario, runs=pd.concat(runs)))
    assert figure.axes[1].get_title(loc="left") == f"(b) URLLC rate: {text}"


@pytest.mark.parametrize(("factor", "said"), [(1.004, True), (1.02, False)])
def test_rayleigh_caption_names_curves_that_coincide(
    study: Study, planted: Planted, factor: float, said: bool
) -> None:
    rates = np.where(study.runs["policy"] == "pf", 20.0 * factor, 23.0)
    runs = study.runs.assign(urllc_rate_mbps=20.0, embb_rate_mbps=rates)
    with house_style():
        text = small_print(draw_rayleigh(planted(study.scenario, runs=runs)))
    assert ("eMBB and URLLC under PF coincide (within 0.4 %)" in text) == said
    assert "under DRL" not in text


def test_gain_caption_explains_the_bars_that_are_missing(
    study: Study, planted: Planted, figures: dict[str, Figure]
) -> None:
    """Razumikhin's gains are planted to give the errors of the nominal one; here all do."""
    text = small_print(figures["figX_gain"])
    assert "No bar (Razumikhin): both gains give the same errors." in text
    windows = study.measures("windows")

    def of(error_cm: object) -> Study:
        tables = {"windows": windows.assign(error_cm=error_cm), "growth": study.measures("growth")}
        return planted(study.scenario, measures=tables.__getitem__)

    same = of(2.0)
    with house_style():
        assert "No bar (Krasovskii, Razumikhin, predictor)" in small_print(draw_gain(same))
    other = of(np.where(windows["gain"] == "adjusted", 1.0, 2.0))
    with house_style():
        assert "No bar" not in small_print(draw_gain(other))


def test_training_figure_shows_means_of_rounds(figures: dict[str, Figure], study: Study) -> None:
    """Reward of episode k (from 0) is k + seed, seeds 1 and 2, two episodes a round."""
    frame = study.training["ddpg"]
    curve = training_curve(frame, "urllc_reward", 2)
    assert curve["episode"].tolist() == [2, 4]
    assert curve["mean"].tolist() == pytest.approx([2.0, 4.0])
    line = figures["fig2_rewards"].axes[1].get_lines()[0]
    assert line.get_xdata().tolist() == [0.5, 1.0]
    assert line.get_ydata().tolist() == pytest.approx([2.0, 4.0])
    backlog = figures["fig3_queues"].axes[0].get_lines()[0].get_ydata()
    expected = frame.groupby((frame["episode"] - 1) // 2)["embb_backlog_packets"].mean()
    assert backlog == pytest.approx(expected.to_numpy())


def test_distribution_of_rates(figures: dict[str, Figure], logs: Path, tiny: Scenario) -> None:
    line = next(
        line
        for line in figures["fig4_rate_cdf"].axes[0].get_lines()
        if line.get_label() == "URLLC, PF"
    )
    rates = []
    for seed in tiny.evaluate.seeds:
        with LogReader(logs / f"runs/evaluate/pf/seed{seed}.mcap") as log:
            rates.append(log.read("/allocation")["rate_mbps"][4:, :2])
    for x, y in list(zip(*line.get_data(), strict=True))[::40]:
        assert y == pytest.approx(np.mean([(rate <= x).mean() for rate in rates]))


def test_a_bar_without_an_upper_bound_is_an_arrow_that_stretches_no_axis() -> None:
    figure = Figure()
    axes = figure.subplots()
    hi = [np.inf, 2.5]
    rows = pd.DataFrame({"x": [1.0, 2.0], "x_lo": [0.5, 1.5], "x_hi": hi})
    draw_series(axes, [1.0, 2.0], rows, "x", policy_look("pf"))
    _, ends = bars(axes)["PF"]
    assert ends.tolist() == [[0.5, 1.0], [1.5, 2.5]]
    (arrow,) = axes.texts
    assert (arrow.xyann, arrow.xy) == ((1.0, 1.0), (1.0, 1.0))  # data; and the top of the panel
    assert arrow.xycoords == ("data", "axes fraction")
    figure.canvas.draw()
    assert axes.get_ylim()[1] < 3.0
    assert arrows_text(hi) == " Arrows: no upper bound."
    assert arrows_text(hi[1:]) == ""


def test_bounds_that_are_infinite_leave_figures_readable(study: Study, planted: Planted) -> None:
    """As those of two worlds are that hardly differ: arrows, which the captions explain."""
    runs = study.runs[study.runs["seed"].isin((11, 12, 21, 22))]
    factor = np.where(runs["seed"] % 10 == 1, 1.0, 1.5)
    few = runs.assign(tracking_error_cm=factor, mean_square_backlog=100.0 * factor)
    with house_style():
        load, pareto = (
            draw(planted(study.scenario, runs=few)) for draw in (draw_load, draw_pareto)
        )
    for figure in (load, pareto):
        figure.canvas.draw()
        assert "Arrows: no upper bound." in small_print(figure)
    assert load.axes[2].get_ylim()[1] < 100.0 * few["mean_square_backlog"].max()
    assert pareto.axes[1].get_xlim()[1] < 2.0 * few["tracking_error_cm"].max()
    assert len(pareto.axes[1].texts) == runs["policy"].nunique()


def test_zero_on_a_logarithmic_axis_is_marked_as_such() -> None:
    figure = Figure()
    axes = figure.subplots()
    mean = np.array([0.0, 2e-4, 0.1])
    floor = zero_floor(mean)
    assert floor < 2e-5
    rows = pd.DataFrame({"x": mean, "x_lo": mean - 0.01, "x_hi": mean + 0.01})
    draw_series(axes, [1, 2, 3], rows, "x", policy_look("pf"), floor=floor)
    log_axis_with_zero(axes, floor, [0.1, np.nan])
    points, ends = bars(axes)["PF"]
    assert points[1] == pytest.approx([floor, 2e-4, 0.1])
    assert ends[:, 0] == pytest.approx([floor, floor, 0.09])
    figure.canvas.draw()
    assert axes.get_yticks()[0] == floor
    assert axes.get_yticklabels()[0].get_text() == "0"
    assert axes.get_ylim()[0] < floor
    (open_mark,) = [line for line in axes.get_lines() if line.get_markerfacecolor() == "white"]
    assert open_mark.get_data()[0].tolist() == [1.0]


def test_policies_tell_apart_in_grey() -> None:
    names = ("ddpg pf max_weight drift_plus_penalty pf_average round_robin max_rate m_lwdf").split()
    looks = [policy_look(name) for name in (*names, "exp_pf", "log_rule", "edf")]
    assert len({look.marker for look in looks}) == len(looks)
    assert len({str(look.dashes) for look in looks}) == len(looks)


def test_rules_by_the_task_have_their_own_look(smoke_scenario: Scenario) -> None:
    """The first policy of each; a second one has that of its place, as other policies have."""
    urgency, pf = RULES["urgency"](), RULES["pf"]()
    policies = {"fast": urgency, "loud": pf, "faster_still": urgency}
    scenario = replace(smoke_scenario, policies=policies)
    looks = {name: policy_look(name, scenario) for name in policies}
    assert looks["fast"] == RULES["urgency"].look._replace(label="fast")
    assert looks["faster_still"].label == "faster still"
    assert len({look.color for look in looks.values()}) == 3


def test_importing_study_is_light() -> None:
    code = (
        "import sys\n"
        "import hiersched.study.metrics, hiersched.study.registry, hiersched.study.statistics\n"
        "print([m for m in ('pandas', 'matplotlib', 'torch', 'cvxpy') if m in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"
