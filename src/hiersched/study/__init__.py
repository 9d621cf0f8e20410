"""Tables and figures, computed from the logs alone.

Importing this package is light: pandas and matplotlib load with `write_tables` and `draw_figures`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hiersched.study.figures import draw_figures
    from hiersched.study.tables import write_tables

__all__ = ["draw_figures", "write_tables"]


def __getattr__(name: str) -> Any:
    """Load the modules that need pandas or matplotlib on first use."""
    if name == "write_tables":
        from hiersched.study.tables import write_tables

        return write_tables
    if name == "draw_figures":
        from hiersched.study.figures import draw_figures

        return draw_figures
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
