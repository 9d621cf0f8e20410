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


@figure(
    "figX_gain_cells",
    title="Tracking error of every method under constant delays, delays that grow and fall, turns "
    "for which no gain is certified, and wrong beliefs.",
    reads=("windows",),
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
            style.draw_mark(axes, row, "error_cm", place, look, floor=0.01, linestyle="none")
        axes.plot([], [], color=look.color, marker=look.marker, linestyle="none", label=look.label)
    for boundary in range(1, len(cells)):
        axes.axhline(boundary - 0.5, color="#dddddd", linewidth=0.6, zorder=0)
    axes.axvline(OFF_TRACK_CM, color=style.GREY, linewidth=0.9, linestyle=(0, (4, 2)))
    axes.set_xscale("log")
    axes.set_yticks(range(len(cells)), [cell.replace("_", " ") for cell in cells])
    axes.set_ylim(len(cells) - 0.5, -0.5)
    axes.set_xlabel("RMS over a window, mean over windows and robots [cm]")
    axes.grid(visible=False, axis="y")
    style.shared_legend(figure, axes)
    style.caption(
        figure,
        f"{own.sweep_robots} robots, {own.cell_windows - 1} windows of "
        f"{study.scenario.robot.window_s:g} s behind the first, {len(own.seeds)} seeds; bars: 95 % "
        f"intervals (Student t). Dashed: {OFF_TRACK_CM:g} cm, off track. Cells: docs/control.md.",
    )
    return figure
