"""A perceptron policy as ONNX, to be run without prefrl and without torch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from prefrl.policies.mlp import NumpyActor
from prefrl.types import Floats

OPSET, FORMAT = 17, 8
"""Of 2022, so that older runtimes read it as well; nothing newer is needed."""

ACTIVATIONS = {"tanh": "Tanh", "relu": "Relu"}


def save_onnx(actor: NumpyActor, path: Path) -> None:
    """Write the policy's mode, with its normaliser and the box of its actions inside.

    `observations` (n, O) float32, raw -> `actions`: (n, A) float32 within the bounds, or (n,) int64, the number of the
    discrete action.
    """
    graph = _Graph()
    last = graph.add("Mul", graph.add("Sub", "observations", actor.scaling.mean), actor.scaling.scale)
    if np.isfinite(actor.scaling.clip):
        last = graph.add("Clip", last, np.array(-actor.scaling.clip), np.array(actor.scaling.clip))
    for number, (weight, bias) in enumerate(actor.layers):
        last = last if number == 0 else graph.add(ACTIVATIONS[actor.activation], last)
        last = graph.add("Gemm", last, weight, bias[0])
    size, space = actor.scaling.mean.shape[0], actor.space
    if space.middle is None or space.half is None or space.clip is None:
        graph.add("ArgMax", last, to="actions", axis=1, keepdims=0)
        output = helper.make_tensor_value_info("actions", TensorProto.INT64, ["n"])
    else:
        if space.squash:
            within = graph.add("Where", np.isfinite(space.clip), graph.add("Tanh", last), last)
        else:
            within = graph.add("Max", graph.add("Min", last, space.clip), -space.clip)
        graph.add("Add", graph.add("Mul", within, space.half), space.middle, to="actions")
        output = helper.make_tensor_value_info("actions", TensorProto.FLOAT, ["n", space.size])
    given = helper.make_tensor_value_info("observations", TensorProto.FLOAT, ["n", size])
    made = helper.make_graph(graph.nodes, "policy", [given], [output], graph.constants)
    model = helper.make_model(made, producer_name="prefrl", opset_imports=[helper.make_opsetid("", OPSET)])
    model.ir_version = FORMAT
    onnx.checker.check_model(model)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(model.SerializeToString())


class _Graph:
    """Nodes in order, and the constants that they read."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def add(self, operation: str, *inputs: str | Floats, to: str = "", **attributes: int) -> str:
        """A node; gives the name of its output."""
        names = [one if isinstance(one, str) else self._constant(one) for one in inputs]
        output = to or f"{operation.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operation, names, [output], **attributes))
        return output

    def _constant(self, value: Floats) -> str:
        name = f"constant_{len(self.constants)}"
        kind = bool if np.asarray(value).dtype == bool else np.float32
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(value, kind).reshape(np.shape(value)), name))
        return name


__all__ = ["save_onnx"]
