"""Trained odometry for programs without this package: ONNX models, or one StableHLO program.

`run` exports a run. `programs` are the functions that are exported, `flat_state` the filter's state
as named arrays, `conversion` and `precision` make ONNX models of them, `odometry` the StableHLO
program. `driver` is the loop around the models, `accuracy` how far they are from the package,
`manifest` what `export.json` says. docs/deployment.md explains the loop.
"""

from gnio_jax.deployment.odometry import load_odometry
from gnio_jax.deployment.run import Exported, export_run

__all__ = ["Exported", "export_run", "load_odometry"]
