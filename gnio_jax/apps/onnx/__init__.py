"""A trained network and its filter as ONNX models, for programs without this package.

`run` exports a run. `programs` are the functions that are exported, `flat_state` the state of the
filter as named arrays, and `conversion` turns the functions into models. `driver` is the loop
around the models, `accuracy` measures how far they are from the package. docs/deployment.md
explains the loop.
"""

from gnio_jax.apps.onnx.run import Exported, export_run

__all__ = ["Exported", "export_run"]
