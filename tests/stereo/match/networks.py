"""Small networks for tests, made node by node."""

from itertools import count

import numpy as np
import onnx
from onnx import helper, numpy_helper

FLOAT = onnx.TensorProto.FLOAT


class Graph:
    """Nodes and constants under construction."""

    def __init__(self):
        self.nodes, self.constants, self._numbers = [], [], count()

    def constant(self, values, dtype=np.float32):
        name = f"c{next(self._numbers)}"
        self.constants.append(numpy_helper.from_array(np.asarray(values, dtype), name))
        return name

    def add(self, kind, *inputs, **attributes):
        name = f"n{next(self._numbers)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [name], **attributes))
        return name

    def cut(self, name, axis, start, end):
        bounds = [self.constant([n], np.int64) for n in (start, end, axis)]
        return self.add("Slice", name, *bounds)

    def write(self, path, inputs, output):
        """Write a network with inputs of declared shapes."""
        graph = helper.make_graph(
            self.nodes,
            "made",
            [helper.make_tensor_value_info(name, FLOAT, shape) for name, shape in inputs.items()],
            [helper.make_tensor_value_info(output, FLOAT, None)],
            self.constants,
        )
        opset = [helper.make_opsetid("", 13)]
        onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=8), str(path))
        return path


def write_matcher(path, ndisp=24, *, channels=1, stacked=False, size=(None, None), last=None):
    """Write a network that matches: sums of absolute differences, and a soft minimum.

    ``last(graph, disparity)`` adds nodes to its end; ``size`` is height and width.
    """
    graph = Graph()
    if stacked:
        inputs = {"both": (1, 2 * channels, *size)}
        left = graph.cut("both", 1, 0, channels)
        right = graph.cut("both", 1, channels, 2 * channels)
    else:
        inputs = dict.fromkeys(("left", "right"), (1, channels, *size))
        left, right = inputs
    pads = graph.constant([0, 0, 0, ndisp, 0, 0, 0, 0], np.int64)
    wide = graph.add("Pad", right, pads, graph.constant(9.0))
    costs = []
    for d in range(ndisp):
        moved = graph.cut(wide, 3, ndisp - d, -d or np.iinfo(np.int64).max)
        apart = graph.add("Abs", graph.add("Sub", left, moved))
        mean = graph.add("ReduceMean", apart, axes=[1], keepdims=1)
        pooled = {"kernel_shape": [7, 7], "pads": [3] * 4, "count_include_pad": 0}
        costs.append(graph.add("AveragePool", mean, **pooled))
    cost = graph.add("Concat", *costs, axis=1)
    likely = graph.add("Softmax", graph.add("Mul", cost, graph.constant(-150.0)), axis=1)
    numbers = graph.constant(np.arange(ndisp).reshape(1, -1, 1, 1))
    output = graph.add("Conv", likely, numbers)
    return graph.write(path, inputs, output if last is None else last(graph, output))
