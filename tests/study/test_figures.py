from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hiersched.study.collect import (
    cell_frame,
    evaluation_frame,
    gain_frame,
    sweep_frame,
    training_frame,
)
from hiersched.study.comparison import bound_frame, bound_table, generalisation_table
from hiersched.study.distributions import delay_tails
from hiersched.study.figures_comparison import draw_load, draw_pareto, pareto_front
from hiersched.study.figures_delay import draw_violations
from hiersched.study.figures_gain import draw_gain
from hiersched.study.figures_rates import draw_dexterity, draw_rayleigh
from hiersched.study.figures_training import training_curve
from hiersched.study.style import (
    arrows_text,
    draw_series,
    house_style,
    log_axis_with_zero,
    policy_look,
    zero_floor,
)
from hiersched.study.summary import gain_table, policy_table, sweep_table
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Annotation

from hiersched.scenario import Scenario
from hiersched.study.figures import build_figures, draw_figures

NAMES = (
    "fig2_rewards fig3_queues fig4_rate_cdf fig5_rayleigh fig6_sampling fig7_dexterity "
    "fig8_violations figX_learning figX_learners figX_load figX_delay figX_pareto figX_bound "
    "figX_generalise figX_gain "
    "figX_gain_grid figX_gain_sweeps figX_gain_traces "
    "figX_gain_stability"
).split()


@pytest.fixture(scope="module")
def figures(results: Path, tiny: Scenario) -> dict[str, Figure]:
    with house_style():
        return {name: draw() for name, draw in build_figures(results, tiny).items()}


@pytest.fixture(scope="module")
def sweeps(results: Path, tiny: Scenario) -> pd.DataFrame:
    return sweep_table(sweep_frame(results, tiny), tiny)


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


def test_every_figure_is_written_twice_and_the_same_each_time(
    results: Path, tiny: Scenario
) -> None:
    written = draw_figures(results, tiny)
    assert [path.name for path in written] == [f"{n}.{s}" for n in NAMES for s in ("svg", "png")]
    first = {path: path.read_bytes() for path in written}
    assert all(data[:8] == b"\x89PNG\r\n\x1a\n" for p, data in first.items() if p.suffix == ".png")
    assert all(b"<dc:date>" not in data for data in first.values())
    draw_figures(results, tiny)
    changed = [path.name for path, data in first.items() if path.read_bytes() != data]
    assert not changed
    assert not list((results / "figures").glob("*.part"))


def test_every_panel_has_title_units_and_data(figures: dict[str, Figure]) -> None:
    for name, figure in figures.items():
        for axes in figure.axes:
            if axes.get_label() == "<colorbar>":
                continue
            assert axes.has_data(), name
            assert axes.get_title(loc="left"), name
            inner = not axes.xaxis.get_tick_params()["labelbottom"]  # the panel below has it
            assert axes.get_xlabel() or inner, name
    for name in set(NAMES) - {"fig4_rate_cdf", "fig8_violations", "figX_delay", "figX_bound"}:
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
    figures: dict[str, Figure], results: Path, tiny: Scenario
) -> None:
    axes = figures["fig8_violations"].axes[0]
    table = policy_table(evaluation_frame(results, tiny), tiny).set_index("policy")
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
    figures: dict[str, Figure], results: Path, tiny: Scenario
) -> None:
    table = gain_table(gain_frame(results, tiny))
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


def set_mean(table: pd.DataFrame, measure: str, mean: object) -> None:
    """Write means with intervals of 10 % to both sides."""
    table[measure] = mean
    table[f"{measure}_lo"], table[f"{measure}_hi"] = 0.9 * table[measure], 1.1 * table[measure]


@pytest.mark.parametrize("none_late", [True, False])
def test_captions_speak_of_open_marks_only_where_there_are_some(
    results: Path, tiny: Scenario, sweeps: pd.DataFrame, none_late: bool
) -> None:
    runs = evaluation_frame(results, tiny)
    late = "urllc_late_share"
    runs[late] = np.where(runs["policy"] == "ddpg", 0.0 if none_late else 0.01, 0.2)
    load = sweeps.copy()
    set_mean(load, late, np.where(load["policy"] == "ddpg", 0.0 if none_late else 0.01, 0.2))
    tails = delay_tails(results, tiny)
    with house_style():
        figures = (
            draw_violations(policy_table(runs, tiny), runs, tails, tiny),
            draw_load(load, tiny),
        )
    for figure in figures:
        assert ("Open mark at 0" in small_print(figure)) == none_late
        assert "dotted line" in small_print(figure)


def test_the_upper_bound_of_a_share_of_0_is_drawn(tiny: Scenario, sweeps: pd.DataFrame) -> None:
    late = "urllc_late_share"
    load = sweeps.copy()
    set_mean(load, late, np.where(load["policy"] == "ddpg", 0.0, 0.2))
    load.loc[load["policy"] == "ddpg", f"{late}_hi"] = 1e-7
    with house_style():
        panel = draw_load(load, tiny).axes[0]
    (_, y), ends = bars(panel)["DRL (DDPG)"]
    assert (y < 1e-7).all()
    assert ends[:, 1] == pytest.approx(np.full(len(y), 1e-7))


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
    figures: dict[str, Figure], results: Path, tiny: Scenario
) -> None:
    tails = delay_tails(results, tiny)
    assert list(dict.fromkeys(tails["policy"])) == list(tiny.evaluate.policies)
    left, right = figures["figX_delay"].axes
    assert right.get_ylim()[0] == 1e-4
    (line,) = [line for line in right.get_lines() if line.get_label() == "PF"]
    own = tails[tails["policy"] == "pf"]
    assert line.get_ydata()[:20] == pytest.approx(own["share"].to_numpy()[:20])
    assert len(left.collections) == 2  # bands of those that the sweeps compare


def test_pareto_front_is_what_no_other_beats(
    figures: dict[str, Figure], results: Path, tiny: Scenario
) -> None:
    frame = pd.DataFrame({"less": [3, 1, 2, 2, 4], "more": [5, 1, 4, 3, 5], "name": list("abcde")})
    assert list(pareto_front(frame, "less", "more")["name"]) == ["b", "c", "a"]
    table = policy_table(evaluation_frame(results, tiny), tiny).set_index("policy")
    (points, _) = bars(figures["figX_pareto"].axes[1])["PF"]
    assert points[:, 0] == pytest.approx(table.loc["pf", ["tracking_error_cm", "embb_rate_mbps"]])


def test_bound_figure_shows_the_table(figures: dict[str, Figure], results: Path) -> None:
    table = bound_table(bound_frame(results))
    own = table[table["states_of"] == table["decider"]].set_index("decider")
    left, right = figures["figX_bound"].axes
    names = [text.get_text() for text in left.get_yticklabels()]
    assert names == ["PF", "flat", "DRL (DDPG)", "drift-plus-penalty"]
    means = {c.lines[0].get_ydata()[0]: c.lines[0].get_xdata()[0] for c in left.containers}
    assert means[0] == pytest.approx(own.loc["pf", "gap"]) == 200.0
    assert means[1] == pytest.approx(60.0)
    assert means[2] == pytest.approx(50.0)
    assert len(right.containers) == 4


def test_cells_figure_shows_the_table(
    figures: dict[str, Figure], results: Path, tiny: Scenario
) -> None:
    table = generalisation_table(cell_frame(results, tiny), tiny)
    axes = figures["figX_generalise"].axes[1]
    rows = table[table["policy"] == "ddpg"]
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
    tiny: Scenario, sweeps: pd.DataFrame, rates: tuple[float, ...], text: str
) -> None:
    first = sweeps[(sweeps["axis"] == "reference") & (sweeps["policy"] == "ddpg")].iloc[[0]]
    table = pd.concat([first] * 3, ignore_index=True)
    # Listed against the order of the index: the order of the rows must not matter.
    set_mean(table, "dexterity_index", [0.9, 0.8, 0.7])
    set_mean(table, "urllc_rate_mbps", rates[::-1])
    with house_style():
        figure = draw_dexterity(table, tiny)
    assert figure.axes[1].get_title(loc="left") == f"(b) URLLC rate: {text}"


@pytest.mark.parametrize(("factor", "said"), [(1.004, True), (1.02, False)])
def test_rayleigh_caption_names_curves_that_coincide(
    tiny: Scenario, sweeps: pd.DataFrame, factor: float, said: bool
) -> None:
    table = sweeps.copy()
    set_mean(table, "urllc_rate_mbps", 20.0)
    set_mean(table, "embb_rate_mbps", np.where(table["policy"] == "pf", 20.0 * factor, 23.0))
    with house_style():
        text = small_print(draw_rayleigh(table, tiny))
    assert ("eMBB and URLLC under PF coincide (within 0.4 %)" in text) == said
    assert "under DRL" not in text


@pytest.mark.parametrize("case", ["bounded", "equal", "unbounded"])
def test_gain_caption_explains_only_the_bars_that_are_missing(
    results: Path, tiny: Scenario, case: str
) -> None:
    table = gain_table(gain_frame(results, tiny))
    table = table[table["method"] == "krasovskii"].copy()
    bounds = ["ratio", "ratio_lo", "ratio_hi"]
    if case == "equal":
        table[bounds] = 1.0
    elif case == "unbounded":
        table["ratio_lo"], table["ratio_hi"] = -np.inf, np.inf
    with house_style():
        text = small_print(draw_gain(table, tiny))
    assert ("the same errors" in text) == (case == "equal")
    assert ("the interval is unbounded" in text) == (case == "unbounded")


def test_training_figure_shows_means_of_rounds(
    figures: dict[str, Figure], results: Path, tiny: Scenario
) -> None:
    """Reward of episode k (from 0) is k + seed, seeds 1 and 2, two episodes a round."""
    frame = training_frame(results, tiny, "ddpg")
    curve = training_curve(frame, "urllc_reward", 2)
    assert curve["episode"].tolist() == [2, 4]
    assert curve["mean"].tolist() == pytest.approx([2.0, 4.0])
    line = figures["fig2_rewards"].axes[1].get_lines()[0]
    assert line.get_xdata().tolist() == [0.5, 1.0]
    assert line.get_ydata().tolist() == pytest.approx([2.0, 4.0])
    backlog = figures["fig3_queues"].axes[0].get_lines()[0].get_ydata()
    expected = frame.groupby((frame["episode"] - 1) // 2)["embb_backlog_packets"].mean()
    assert backlog == pytest.approx(expected.to_numpy())


def test_distribution_of_rates(figures: dict[str, Figure], results: Path, tiny: Scenario) -> None:
    from hiersched.log import LogReader

    line = next(
        line
        for line in figures["fig4_rate_cdf"].axes[0].get_lines()
        if line.get_label() == "URLLC, PF"
    )
    rates = []
    for seed in tiny.evaluate.seeds:
        with LogReader(results / "eval/pf" / f"seed{seed}.mcap") as log:
            rates.append(log.read("/allocation")["rate_mbps"][:, :2])
    for x, y in list(zip(*line.get_data(), strict=True))[::40]:
        assert y == pytest.approx(np.mean([(rate <= x).mean() for rate in rates]))


def test_a_bar_without_an_upper_bound_is_an_arrow_that_stretches_no_axis() -> None:
    figure = Figure()
    axes = figure.subplots()
    hi = [np.inf, 2.5]
    draw_series(axes, [1.0, 2.0], [1.0, 2.0], [0.5, 1.5], hi, policy_look("pf"))
    _, ends = bars(axes)["PF"]
    assert ends.tolist() == [[0.5, 1.0], [1.5, 2.5]]
    (arrow,) = axes.texts
    assert (arrow.xyann, arrow.xy) == ((1.0, 1.0), (1.0, 1.0))  # data; and the top of the panel
    assert arrow.xycoords == ("data", "axes fraction")
    figure.canvas.draw()
    assert axes.get_ylim()[1] < 3.0
    assert arrows_text(hi) == " Arrows: no upper bound."
    assert arrows_text(hi[1:]) == ""


def test_bounds_that_are_infinite_leave_figures_readable(
    results: Path, tiny: Scenario, sweeps: pd.DataFrame
) -> None:
    """As those of two worlds are: arrows, which the captions explain."""
    table = sweeps.copy()
    for name in ("tracking_error_cm", "mean_square_backlog"):
        table[f"{name}_hi"] = np.inf
    policies = policy_table(evaluation_frame(results, tiny), tiny)
    policies["tracking_error_cm_hi"] = np.inf
    with house_style():
        load, pareto = draw_load(table, tiny), draw_pareto(policies, tiny)
    for figure in (load, pareto):
        figure.canvas.draw()
        assert "Arrows: no upper bound." in small_print(figure)
    assert load.axes[2].get_ylim()[1] < 100.0 * table["mean_square_backlog"].max()
    assert pareto.axes[1].get_xlim()[1] < 2.0 * policies["tracking_error_cm"].max()
    assert len(pareto.axes[1].texts) == len(policies)


def test_zero_on_a_logarithmic_axis_is_marked_as_such() -> None:
    figure = Figure()
    axes = figure.subplots()
    mean = np.array([0.0, 2e-4, 0.1])
    floor = zero_floor(mean)
    assert floor < 2e-5
    draw_series(axes, [1, 2, 3], mean, mean - 0.01, mean + 0.01, policy_look("pf"), floor=floor)
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


def test_importing_study_is_light() -> None:
    code = (
        "import sys, hiersched.study, hiersched.study.metrics, hiersched.study.statistics\n"
        "print([m for m in ('pandas', 'matplotlib', 'torch', 'cvxpy') if m in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"
