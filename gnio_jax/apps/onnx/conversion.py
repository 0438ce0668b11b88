"""A program as an ONNX model.

Only this module imports jax2onnx. While it traces, jax2onnx replaces layers of Flax and functions
of jax.numpy by its own. A program is therefore traced here, and jax2onnx sees only primitives of
JAX: it converts the program that runs.
"""

# The extra `onnx` need not be installed where types are checked, and this folder has its name.
# pyright: reportMissingImports=false, reportAttributeAccessIssue=false

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jax.extend.core import jaxpr_as_fun

from gnio_jax.apps.onnx.programs import Program
from gnio_jax.errors import InputError
from gnio_jax.filtering import Filter

OPSET = 18
"""Version of the ONNX operators, which ONNX Runtime 1.14 or newer reads."""


def to_model(program: Program, ekf: Filter, first_inferred: int) -> bytes:
    """The file of a model, weights included, whose inputs and outputs have the program's names,
    shapes and types.

    float64 stays float64. The metadata have the numbers that the loop around the models needs.
    Raises `InputError` for an operation that jax2onnx does not know.
    """
    import onnx
    import onnx_ir
    from jax2onnx import to_onnx
    from onnx_ir.passes.common import RemoveUnusedNodesPass

    names, shapes = list(program.inputs), list(program.inputs.values())

    def call_flat(*values: Any) -> list[Any]:
        results = program.function(dict(zip(names, values, strict=True)))
        return [results[name] for name in program.outputs]

    try:
        converted = to_onnx(
            jaxpr_as_fun(jax.make_jaxpr(call_flat)(*shapes)),
            shapes,
            model_name=program.name,
            opset=OPSET,
            enable_double_precision=any(shape.dtype == np.float64 for shape in shapes),
            return_mode="ir",
        )
    except NotImplementedError as error:
        remedy = "write the network without it, or install a version of jax2onnx that converts it"
        raise InputError(program.name, f"cannot be converted: {error}", remedy) from error
    model = onnx_ir.to_proto(RemoveUnusedNodesPass()(converted).model)
    _name_ends(model.graph, program)
    metadata = {
        "rate": f"{1 / ekf.config.dt:.17g}",
        "first_inferred": str(first_inferred),
        "first_measured": str(ekf.config.first_measured),
        "log_std_min": f"{ekf.config.log_std_min:.17g}",
    }
    onnx.helper.set_model_props(model, metadata)
    onnx.checker.check_model(model)
    return model.SerializeToString()


def _name_ends(graph: Any, program: Program) -> None:
    """Give inputs and outputs their names, by copies at both ends, because one value may be two
    outputs, or an input and an output. ONNX Runtime removes the copies."""
    from onnx import helper

    inputs = zip(program.inputs, graph.input, strict=True)
    outputs = zip(program.outputs, graph.output, strict=True)
    nodes = [
        *(helper.make_node("Identity", [name], [port.name]) for name, port in inputs),
        *graph.node,
        *(helper.make_node("Identity", [port.name], [name]) for name, port in outputs),
    ]
    del graph.node[:], graph.input[:], graph.output[:], graph.value_info[:]
    graph.node.extend(nodes)
    for ends, arrays in ((graph.input, program.inputs), (graph.output, program.outputs)):
        for name, shape in arrays.items():
            dtype = helper.np_dtype_to_tensor_dtype(shape.dtype)
            ends.append(helper.make_tensor_value_info(name, dtype, shape.shape))
