"""Compilation for tests: without the compiler's optimisation it takes half the time, and what runs
once is as quick."""

import functools

import jax

quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
