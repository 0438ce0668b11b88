"""A trained network and its filter as ONNX models, for programs without this package.

`run` exports a run and measures the deviation of the models from the package. `programs` has the
exported functions, `conversion` turns them into models, and `driver` is the loop around the models,
which docs/deployment.md explains.
"""

from gnio_jax.apps.onnx.run import ExportResult, export_run

__all__ = ["ExportResult", "export_run"]
