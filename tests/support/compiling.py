"""How tests compile where it matters: as quickly as can be, or as a user's process does."""

import functools
from importlib.metadata import version

import jax

quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
"""Without the compiler's optimisation: half the time, and what runs once is as quick."""

literal = functools.partial(
    jax.jit,
    compiler_options={
        "xla_backend_optimization_level": 0,
        "xla_disable_hlo_passes": "algsimp",
    },
)
"""Without the simplifications either, which would make 0 of 0 · NaN."""

optimised = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 3})
"""With the compiler's optimisation: for what runs longer than it takes to compile."""


_DEFAULTS = {"xla_backend_optimization_level": 3}
if version("jax").startswith("0.10."):
    _DEFAULTS["xla_cpu_use_fusion_emitters"] = True

as_usual = functools.partial(jax.jit, compiler_options=_DEFAULTS)
"""With the compiler's defaults, which `conftest` takes back: for what rests on many steps of
rounding."""
