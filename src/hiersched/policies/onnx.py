"""Policies in ONNX files, on one thread of onnxruntime."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.core.extras import naming_extras
from hiersched.policies.files import FileAgent, OnnxPolicy, PolicyFileError, Spaces, read_file

if TYPE_CHECKING:
    from hiersched.scenario.schema import Scenario

_FLOAT = "tensor(float)"


class Graph(NamedTuple):
    """A graph that is ready to run."""

    session: Any
    input: str  # name of its input
    output: str  # and of its first output
    rows: int | None  # worlds that it takes at once; None: any number
    spaces: Spaces


@lru_cache(maxsize=8)
def open_graph(entry: OnnxPolicy) -> Graph:
    """Open the graph of an entry of `policies`.

    PolicyFileError if it is none, or has other inputs and outputs than one of observations and,
    first, one of actions, each with worlds as its leading axis.
    """
    with naming_extras():
        import onnxruntime
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    options.log_severity_level = 3  # warnings are about the graph's optimisation
    content = read_file(entry, "onnx")
    where = f"onnx = {entry.onnx!r}"
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own kinds, which have no common base
        text = " ".join(str(error).split())
        raise PolicyFileError(
            f"{where}: no graph that onnxruntime runs, in one file with its weights: {text:.300}"
        ) from error
    inputs, outputs = session.get_inputs(), session.get_outputs()
    if len(inputs) != 1:
        raise PolicyFileError(
            f"{where}: inputs {', '.join(one.name for one in inputs)}: must be one, of observations"
        )
    for one in (inputs[0], outputs[0]):
        if one.type != _FLOAT or len(one.shape) < 2:
            raise PolicyFileError(
                f"{where}: {one.name} is {one.type} of shape {one.shape}: must be {_FLOAT} with a "
                "leading axis of worlds"
            )
    shapes = [tuple(_length(length) for length in one.shape) for one in (inputs[0], outputs[0])]
    (rows, *observation), (_, *action) = shapes
    spaces = Spaces(tuple(observation), tuple(action))
    return Graph(session, inputs[0].name, outputs[0].name, rows, spaces)


def _length(length: Any) -> int | None:
    """Return the length of an axis, None where the graph gives it a name."""
    return length if isinstance(length, int) else None


class OnnxAgent(FileAgent):
    """A graph that decides in worlds of one scenario."""

    def __init__(self, entry: OnnxPolicy, scenario: Scenario) -> None:
        self._graph = open_graph(entry)
        super().__init__(entry, self._graph.spaces, scenario)
        if self._graph.rows is not None:
            self.rows = self._graph.rows

    def predict(self, observations: NDArray[np.float32]) -> NDArray[np.floating]:
        """As in `FileAgent`."""
        graph = self._graph
        (actions,) = graph.session.run([graph.output], {graph.input: observations})
        return np.asarray(actions)
