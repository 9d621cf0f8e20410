"""The lower level: methods in the cells of the gain study."""

from __future__ import annotations

from matplotlib.figure import Figure

from hiersched.study.figures import style
from hiersched.study.metrics import OFF_TRACK_CM
from hiersched.study.registry import figure
from hiersched.study.study import Study
from hiersched.study.tables.loops import cells_table, has_loop_cells

_ROW_IN = 0.25
"""Height of a cell."""
_SPREAD = 0.16
"""Distance between the methods of a cell."""
_MOST_CM = 1000.0
"""Larger errors are those of robots that are lost: their marks stand at the edge, open."""


@figure(
    "figX_gain_cells",
    title="Tracking error of every method under constant delays, delays that grow and fall, turns "
    "for which no gain is certified, and wrong beliefs.",
    reads=("windows", "growth"),
    when=has_loop_cells,
)
def draw_gain_cells(study: Study) -> Figure:
    """Draw the tracking error of each method, a row a cell, on a logarithmic axis."""
    table, own = cells_table(study), study.scenario.gain_study
    cells = list(own.cells)
    figure, (axes,) = style.new_figure(1, height_in=1.3 + _ROW_IN * len(cells))
    methods = [method for method in style.GAIN_METHODS if method in set(table["method"])]
    for number, method in enumerate(methods):
        look = style.GAIN_METHODS[method]
        rows = table[table["method"] == method].set_index("cell")
        shift = _SPREAD * (number - 0.5 * (len(methods) - 1))
        for cell, row in rows.iterrows():
            place = cells.index(str(cell)) + shift
            if row["error_cm"] > _MOST_CM:
                style.open_marks(axes, [_MOST_CM], [place], look, clip_on=False, zorder=4)
            else:
                style.draw_mark(axes, row, "error_cm", place, look, floor=0.01, linestyle="none")
        axes.plot([], [], color=look.color, marker=look.marker, linestyle="none", label=look.label)
    for boundary in range(1, len(cells)):
        axes.axhline(boundary - 0.5, color="#dddddd", linewidth=0.6, zorder=0)
    axes.axvline(OFF_TRACK_CM, color=style.GREY, linewidth=0.9, linestyle=(0, (4, 2)))
    axes.set_xscale("log")
    if table["error_cm"].max() > _MOST_CM:
        axes.set_xlim(right=_MOST_CM)
    axes.set_yticks(range(len(cells)), [cell.replace("_", " ") for cell in cells])
    axes.set_ylim(len(cells) - 0.5, -0.5)
    unit = "cm" if study.scenario.plant.has_pose else "0.01 of the error states' unit"
    axes.set_xlabel(f"RMS over a window, mean over windows and robots [{unit}]")
    axes.grid(visible=False, axis="y")
    axes.set_title("methods at forced delays")
    style.shared_legend(figure, axes)
    style.caption(
        figure,
        f"{own.sweep_robots} robots, {own.cell_windows - 1} windows of "
        f"{study.scenario.robot.window_s:g} s behind the first, {len(own.seeds)} seeds; bars: 95 % "
        f"intervals (Student t). Dashed: {OFF_TRACK_CM:g}, off track. Open marks: beyond the "
        "edge.",
    )
    return figure
