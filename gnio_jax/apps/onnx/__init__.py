"""A trained network and its filter as ONNX models, for programs without this package.

`run` exports a run and measures how far the models are from the package. `programs` are the
functions that are exported, `conversion` turns them into models, and `driver` is the loop around
the models, which docs/deployment.md explains.
"""

from gnio_jax.apps.onnx.run import Exported, export_run

__all__ = ["Exported", "export_run"]
