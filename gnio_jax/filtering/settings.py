"""The filter's settings: those that are fixed when it is compiled, those of an experiment, and its
numbers as free parameters."""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import GetAttrKey, keystr, tree_leaves_with_path

from gnio_jax.config import DataConfig, FilterOptions, FilterSettings
from gnio_jax.config.files import check_value
from gnio_jax.config.schema import (
    FACTOR_LIMITS,
    Count,
    Entries,
    Location,
    NonNegative,
    NonNegativeCount,
    Positive,
)
from gnio_jax.windows import WINDOW_CUTS, WindowCut

_NUMBERS = ("noise", "start", "considered", "measurements")
_OPTIONS = tuple(field.name for field in dataclasses.fields(FilterOptions))
_OTHERS = [field.name for field in dataclasses.fields(FilterSettings) if field.name not in _NUMBERS]
jax.tree_util.register_dataclass(FilterSettings, list(_NUMBERS), _OTHERS)


jax.tree_util.register_pytree_with_keys(
    Entries,
    lambda entries: (
        [(GetAttrKey(name), value) for name, value in entries.items()],
        tuple(entries),
    ),
    lambda names, values: Entries(dict(zip(names, values, strict=True))),
)

DisplacementFrame = Literal["own", "turning", "given", "body"]
"""The frame in which a displacement is expressed.

own: the yaw frame of the filter's own attitude of the oldest clone, with which the network's window
was cut. turning: the same frame, whose derivatives are those with the network in the loop. The
displacement turns with the frame, so only the turn of the clone about z has an effect, and the
frame has a derivative where the x axis is vertical (`consider.sensitivity`). given: the yaw frame
of another attitude. body: the body at the newest clone, for the velocity there in metres per
window."""


def differentiable_frame(frame: DisplacementFrame) -> DisplacementFrame:
    """The same frame with the derivatives of a run with its network."""
    return "turning" if frame == "own" else frame


@no_type_check  # The tests' run-time checker would refuse what __post_init__ converts or names.
@dataclass(frozen=True)
class FilterConfig(FilterOptions):
    """Static settings of the filter: the options of an experiment, the grid of its windows, and how
    it is computed (`FIXED`). The defaults are TLIO's.

    Numbers may come as 0-d arrays, as NumPy files give them. Raises `InputError`, a `ValueError`,
    naming a field that makes no sense.
    """

    dt: Positive
    """Time between IMU samples, s."""
    samples_per_clone: Count
    """IMU samples n in one clone interval."""
    clones_per_window: Count
    """Clone intervals W in one measurement; W + 1 poses are cloned."""
    context_samples: NonNegativeCount = dataclasses.field(default=0, kw_only=True)
    """IMU samples C before a measurement's window that the network sees too (ours)."""
    history: Literal["diagonal", "core"] = "diagonal"
    """Keep the diagonal of the core covariance at every interval, or the whole 15×15 block too."""
    window_rotation: Literal["per_sample", "single", "body_axes", "hidden_axes", "tlio"] = (
        "per_sample"
    )
    """How the network's window is rotated. per_sample: each sample with its own attitude. single:
    all with that of the start (paper eq. 1 read literally). body_axes: as per_sample, with the x
    and y axes of the body as six more channels; hidden_axes: with zeros there. tlio: the window is
    cut and rotated as in TLIO's tracker, one sample earlier and without subtracting the biases."""
    gate_softness: NonNegative = 0.0
    """0 accepts or rejects; above 0 the gate has a slope, for training: a measurement's information
    is weighted by the logistic function of (gate_threshold − rᵀ S⁻¹ r) / gate_softness."""
    checkpoint_every: NonNegativeCount = 0
    """Clone intervals between the states kept for the backward pass, which computes everything else
    again: less memory, more time. 0 keeps everything."""
    truncate_every: NonNegativeCount = 0
    """Number of clone intervals after which the state continues without gradient, for training on
    long recordings. Values do not change. The final state then has no gradient. 0: never."""
    allow_float32: bool = False
    """Run in float32 if the state is float32: every standard deviation keeps about four digits over
    an hour. Without this setting float32 is refused. Smoothing and derivatives need float64 in any
    case."""

    def __post_init__(self) -> None:
        classes = reversed(type(self).__mro__[:-1])
        hints = [inspect.get_annotations(kind, eval_str=True) for kind in classes]
        for name, hint in itertools.chain(*(of_class.items() for of_class in hints)):
            value = getattr(self, name)
            if isinstance(value, np.ndarray | np.generic) and value.ndim == 0:
                value = value.item()
            object.__setattr__(self, name, check_value(hint, value, Location("FilterConfig", name)))
        if self.gate_softness and self.mahalanobis_fail_scale:
            problem = "makes no sense beside mahalanobis_fail_scale"
            Location("FilterConfig", "gate_softness").refuse(problem, "set one of them to 0")

    @property
    def window(self) -> int:
        """IMU samples N = n·W in the network's window."""
        return self.samples_per_clone * self.clones_per_window

    @property
    def input_samples(self) -> int:
        """IMU samples C + N that the network sees: the context and the window."""
        return self.context_samples + self.window

    @property
    def channels(self) -> int:
        """Channels of a window."""
        return 12 if self.cut.body_axes else 6

    @property
    def first_measured(self) -> int:
        """Number of the first clone interval that ends with a measurement: all samples on which it
        depends exist, and W intervals come before it, as in TLIO's tracker."""
        before_window = -(-(self.context_samples + self.cut.lead) // self.samples_per_clone)
        return self.clones_per_window + max(before_window - 1, 0)

    @property
    def clone_seconds(self) -> float:
        """Length of a clone interval, s."""
        return self.dt * self.samples_per_clone

    @property
    def clones(self) -> int:
        """Cloned poses W + 1."""
        return self.clones_per_window + 1

    @property
    def cut(self) -> WindowCut:
        """How the network's window is cut: that of `window_rotation`."""
        return WINDOW_CUTS[self.window_rotation]

    @property
    def reach(self) -> int:
        """IMU samples, the newest included, that a measurement depends on."""
        return self.input_samples + self.cut.lead

    @property
    def displacement_frame(self) -> DisplacementFrame:
        """Frame of what the network measures, as the measurement's Jacobian takes it.

        TLIO's Jacobian treats the yaw frame as given, although it is the filter's own.
        """
        if self.measures == "velocity":
            return "body"
        return "given" if self.window_rotation == "tlio" else "own"

    @property
    def derivative_frame(self) -> DisplacementFrame:
        """Frame of what the network measures in a run without it that is differentiated."""
        return differentiable_frame(self.displacement_frame)

    @property
    def invariant(self) -> bool:
        """Whether the error of the state is the invariant one (`error`)."""
        return self.error == "invariant" or (self.error is None and self.window_rotation != "tlio")

    def whole_samples(self, seconds: float) -> int:
        """Largest number t of samples with t·dt ≤ seconds, independently of the rounding of
        seconds / dt."""
        return int(np.floor(seconds / self.dt + 1e-6))


# The filter of an experiment
# ------------------------------------------------------------------------------------------------


def filter_config(windows: DataConfig, settings: FilterSettings) -> FilterConfig:
    """The settings that are fixed when the filter is compiled. The numbers of the settings may be
    traced."""
    return FilterConfig(
        dt=1.0 / windows.rate,
        samples_per_clone=windows.stride,
        clones_per_window=windows.window // windows.stride,
        context_samples=windows.context,
        history="core",
        window_rotation=settings.window_rotation or windows.window_rotation,
        **{name: getattr(settings, name) for name in _OPTIONS},
    )


FIXED = {
    "dt": "data.rate",
    "samples_per_clone": "data.stride_seconds",
    "clones_per_window": "data.window_seconds",
    "context_samples": "data.context_seconds",
    "history": "core: reports and calibration read whole covariances",
    "gate_softness": "training through the filter has a slope of its own; other runs have none",
    "checkpoint_every": "training and calibration bound their memory; other runs have no gradient",
    "truncate_every": "training cuts the gradient; consider covariance needs the whole one",
    "allow_float32": "False: commands run the filter in float64",
}
"""The fields of `FilterConfig` that are no options of an experiment, each with the setting from
which it follows, or with its value and the reason."""


SHARE = "noise.correlation.share"
"""The number that lies between 0 and 1; the others are positive."""
SIGNED = {
    **{f"measurements.nonholonomic.{angle}": 0.1 for angle in ("yaw", "pitch", "roll")},
    **{f"measurements.nonholonomic.lever_{axis}": 1.0 for axis in "xyz"},
    **{f"measurements.nonholonomic.{name}_gradient": 0.01 for name in ("pitch", "sideslip")},
}
"""Numbers that may have any sign, and 0, with the unit in which they are free, rad, m and rad per
m/s². A step of the optimizer is a share of this unit."""
FACTORS = "noise.measurement_scale", *(f"noise.std_factor.{axis}" for axis in range(3))
"""Factors of covariances and standard deviations."""
LIMITS = {SHARE: (0.0, 0.9999)} | dict.fromkeys(FACTORS, FACTOR_LIMITS)
"""Smallest and largest value that is written to a file. Rounding must not make a share 1, and where
errors are all but 0, a fitted factor may have any size."""


def free_parameters(settings: FilterSettings, paths: Iterable[str]) -> dict[str, float]:
    """The numbers of some settings as parameters without bounds, which are fitted and trained: the
    logit of a share, the number over its unit if it may have any sign (`SIGNED`), and the logarithm
    of every other number.

    Each of the `paths` names a number ("noise.gyro_density") or a section of them ("noise"). Any
    other number that is 0 is switched off and has no free parameter.
    """
    paths = tuple(paths)
    free = {}
    for name, value in _numbers(settings).items():
        if not any(is_below(name, path) for path in paths):
            continue
        if name in SIGNED:
            free[name] = value / SIGNED[name]
        elif value > 0:
            free[name] = math.log(value) - (math.log1p(-value) if name == SHARE else 0.0)
    return free


def is_below(name: str, path: str) -> bool:
    """Whether the number `name` has this path, or is in the section of this path."""
    return f"{name}.".startswith(f"{path}.")


def with_free_parameters(settings: FilterSettings, free: Mapping[str, Any]) -> FilterSettings:
    """The settings with the values, float64, of these free parameters. Differentiable."""
    names, structure = _numbers(settings), jax.tree.structure(settings)
    for name in names.keys() & free.keys():
        number = jnp.asarray(free[name], jnp.float64)
        if name in SIGNED:
            names[name] = SIGNED[name] * number
        else:
            names[name] = jax.nn.sigmoid(number) if name == SHARE else jnp.exp(number)
    return jax.tree.unflatten(structure, names.values())


def with_written_parameters(
    settings: FilterSettings, free: Mapping[str, Any], digits: int
) -> FilterSettings:
    """The settings with the values of these free parameters as they are written to a file: floats
    rounded to `digits` digits, within `LIMITS`."""
    names = _numbers(with_free_parameters(settings, free))
    for name in names.keys() & free.keys():
        written = float(f"{float(names[name]):.{digits}g}")
        low, high = LIMITS.get(name, (-math.inf, math.inf))
        names[name] = min(max(written, low), high)
    return jax.tree.unflatten(jax.tree.structure(settings), names.values())


def _numbers(settings: FilterSettings) -> dict[str, Any]:
    """The numbers of the settings by their paths."""
    leaves = tree_leaves_with_path(settings)
    return {keystr(path, simple=True, separator="."): value for path, value in leaves}
