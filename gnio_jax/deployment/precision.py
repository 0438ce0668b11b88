"""The network in float16 or int8."""

# The extra `onnx` need not be installed where types are checked.
# pyright: reportMissingImports=false

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

Precision = Literal["float32", "float16", "int8"]
CALIBRATION_WINDOWS = 256
PRODUCTS = ["Conv", "Gemm", "MatMul"]
"""What int8 is worth its loss for; all else stays float32."""


def in_precision(model: Any, precision: Precision, windows: Float[np.ndarray, "m n 6"]) -> Any:
    """The model of a network, whose inputs and outputs stay float32, in another precision.

    int8 takes the ranges of its activations from some of the `windows`.
    """
    if precision == "float16":
        return _in_float16(model)
    return _in_int8(model, windows) if precision == "int8" else model


def _in_float16(model: Any) -> Any:
    import onnx_ir
    from onnx_ir.passes.common import TopologicalSortPass
    from onnxruntime.transformers.float16 import convert_float_to_float16

    halved = onnx_ir.from_proto(convert_float_to_float16(model, keep_io_types=True))
    return onnx_ir.to_proto(TopologicalSortPass()(halved).model)  # the casts stand at the end


def _in_int8(model: Any, windows: Float[np.ndarray, "m n 6"]) -> Any:
    """Weights in int8 with a scale for each channel, activations with one scale."""
    import onnx
    from onnxruntime.quantization import CalibrationDataReader, quantize_static

    class Reader(CalibrationDataReader):
        """Hands out windows one by one."""

        def __init__(self, rows: Iterator[Any]):
            self._rows = rows

        def get_next(self) -> Any:
            return next(self._rows, None)

    some = windows[:: max(1, len(windows) // CALIBRATION_WINDOWS)]
    rows = ({"window": row[None]} for row in some)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "network.onnx"
        model = _folded(model, path)
        _drop_scalar_zeros(model.graph)
        quantize_static(model, path, Reader(rows), op_types_to_quantize=PRODUCTS, per_channel=True)
        return onnx.load(path)


def _folded(model: Any, path: Path) -> Any:
    """With constants computed, above all kernels transposed: only constants are stored as int8."""
    import onnx
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
    options.optimized_model_filepath = str(path)
    options.log_severity_level = 3
    content = model.SerializeToString()
    onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    return onnx.load(path)


def _drop_scalar_zeros(graph: Any) -> None:
    """Products without the scalar 0 that jax2onnx adds to them: it has no channels to be scaled."""
    from onnx import numpy_helper

    values = {each.name: numpy_helper.to_array(each) for each in graph.initializer}
    for node in graph.node:
        added = (
            values.get(node.input[2]) if node.op_type == "Gemm" and len(node.input) > 2 else None
        )
        if added is not None and added.ndim == 0 and added == 0:
            del node.input[2]
