"""A layout for Foxglove and Lichtblick: the same panels as in Rerun."""

from __future__ import annotations

import math
from typing import Any

from hiersched.core.colours import user_colours
from hiersched.replay.panels import TITLES, Panels, Plot, lines_of
from hiersched.replay.viewer_topics import (
    FRAME,
    IMAGE_TOPIC,
    track_topic,
    trail_topic,
)

_TITLE_KEYS = ("foxglovePanelTitle", "lichtblickPanelTitle")
"""Keys under which the two applications look for the title of a panel."""
_ALPHA = {"pose": 1.0, "reference": 0.45, "set_point": 0.7}
"""How much of the user's colour each track has."""


def foxglove_layout(panels: Panels) -> dict[str, Any]:
    """Lay out the panels of Foxglove (and Lichtblick): the views of Rerun, as JSON to import."""
    configs: dict[str, Any] = {}
    rows = []
    for row in panels.rows:
        ids = [f"Plot!{len(configs) + i}" for i in range(len(row))]
        configs |= dict(zip(ids, (_plot(plot, panels) for plot in row), strict=True))
        rows.append(ids)
    if below := _below(panels):
        configs |= below
        rows.append(list(below))
    return {
        "configById": configs,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _stack([_stack(row, "row") for row in rows]),
    }


def _plot(plot: Plot, panels: Panels) -> dict[str, Any]:
    """Return the settings of a plot over the seconds since the log began, at 0."""
    paths = [
        {
            "value": f"{plot.topic}.{line.field}"
            + ("" if line.place is None else f"[{line.place}]"),
            "label": line.name,
            "color": _css(line.colour),
            "lineSize": 1.0,
            "showLine": True,
            "enabled": True,
            "timestampMethod": "receiveTime",
        }
        for line in lines_of(plot, panels.dims)
    ]
    config = {
        "paths": paths,
        "xAxisVal": "timestamp",
        "showLegend": panels.has_legend(plot),
        "legendDisplay": "floating",
        "showPlotValuesInLegend": False,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "isSynced": True,
        "sidebarDimension": 240,
    }
    return _titled(plot.heading, config)


def _below(panels: Panels) -> dict[str, Any]:
    """Return the panels below the plots, by their ids."""
    found: dict[str, Any] = {}
    if panels.tracks:
        found["3D!0"] = _titled(TITLES["plane"], _plane(panels))
    if panels.has_image:
        image = {"imageMode": {"imageTopic": IMAGE_TOPIC}}
        found["Image!0"] = _titled(TITLES["image"], image)
    if panels.has_events:
        events = {"topicToRender": "/events", "minLogLevel": 1, "searchTerms": []}
        found["RosOut!0"] = _titled(TITLES["events"], events)
    return found


def _titled(title: str, config: dict[str, Any]) -> dict[str, Any]:
    return {**dict.fromkeys(_TITLE_KEYS, title), **config}


def _plane(panels: Panels) -> dict[str, Any]:
    """Return the settings of the plane from above: x to the right, y upwards."""
    colours = user_colours(panels.dims.num_urllc, panels.dims.num_embb)
    topics: dict[str, Any] = {}
    width, height = panels.size
    extent = max(height, width / 1.6, 0.5)
    for robot in range(panels.dims.num_posed):
        for track in panels.tracks:
            colour = _css(colours[robot].tolist(), _ALPHA[track])
            length = extent * (0.06 if track == "pose" else 0.04)
            thick = extent * (0.004 if track == "pose" else 0.012)
            topics[track_topic(robot, track)] = {
                "visible": True,
                "type": "arrow",
                "arrowScale": [length, length / 3, length / 3],
                "color": colour,
            }
            topics[trail_topic(robot, track)] = {
                "visible": True,
                "type": "line",
                "lineWidth": thick,
                "gradient": [_css(colours[robot].tolist(), 0.2 * _ALPHA[track]), colour],
            }
    return {
        "followTf": FRAME,
        "followMode": "follow-none",
        "cameraState": {
            "perspective": False,
            "distance": 1.2 * extent,
            "phi": 0,
            "thetaOffset": 0,
            "target": [0, 0, 0],
            "targetOffset": [*panels.centre, 0],
            "targetOrientation": [0, 0, 0, 1],
            "fovy": 45,
            "near": 0.01,
            "far": 5000,
        },
        "scene": {},
        "transforms": {},
        "topics": topics,
        "layers": {
            "grid": {
                "instanceId": "grid",
                "layerId": "foxglove.Grid",
                "label": "Grid",
                "visible": True,
                "size": 2 * math.ceil(extent),
                "divisions": 2 * math.ceil(extent),
                "lineWidth": 1,
                "color": "#80808060",
                "position": [round(panels.centre[0]), round(panels.centre[1]), 0],
                "rotation": [0, 0, 0],
            }
        },
    }


def _css(colour: Any, alpha: float = 1.0) -> str:
    """Write a colour as ``#rrggbb``, with its opacity as ``#rrggbbaa``."""
    text = "#" + "".join(f"{part:02x}" for part in colour)
    return text if alpha == 1.0 else f"{text}{round(255 * alpha):02x}"


def _stack(parts: list[Any], direction: str = "column") -> Any:
    """Share the space evenly among panels, as a tree of pairs."""
    if len(parts) == 1:
        return parts[0]
    return {
        "first": parts[0],
        "second": _stack(parts[1:], direction),
        "direction": direction,
        "splitPercentage": 100.0 / len(parts),
    }
