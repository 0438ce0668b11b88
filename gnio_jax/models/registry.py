"""Names of networks to Flax modules; every one maps windows (b, n, c) to a `Prediction`.

The fields of a module are its options, but for one whose metadata say `option: False`. Their types
are the choices (`Literal`) or bounds (those of `gnio_jax.config.schema`) of each, and their
defaults the published values.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable
from typing import Annotated, Any, Literal, get_origin, get_type_hints

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import PRNGKeyArray

from gnio_jax import plugins
from gnio_jax.config import ModelConfig, TrainConfig
from gnio_jax.config.files import check_value
from gnio_jax.config.schema import Location
from gnio_jax.errors import InputError, did_you_mean
from gnio_jax.models.ai_imu import AIIMU
from gnio_jax.models.airimu import Corrected
from gnio_jax.models.airio import AirIO
from gnio_jax.models.convolution import winograd_pays
from gnio_jax.models.ctin import CTIN
from gnio_jax.models.deepils import DeepILS
from gnio_jax.models.eqnio import EqNIO
from gnio_jax.models.equivariance import (
    CanonicalFrame,
    DeviceHeading,
    FourHeadings,
    FourHeadingsWithMemory,
    show_device_heading,
)
from gnio_jax.models.experts import Experts
from gnio_jax.models.gnio import GNIO
from gnio_jax.models.gru import GRUNetwork
from gnio_jax.models.imot import IMoT, IMoTText
from gnio_jax.models.ionet import IONet
from gnio_jax.models.ionext import IONext
from gnio_jax.models.memory import NetworkWithMemory
from gnio_jax.models.ridi import RIDI
from gnio_jax.models.ronin import RoNINResNet
from gnio_jax.models.ronin_temporal import RoNINLSTM, RoNINTCN
from gnio_jax.models.state_space import StateSpaceNetwork
from gnio_jax.models.tlio import TLIO
from gnio_jax.models.trunk import Trunk
from gnio_jax.types import Quantity

_MODELS: dict[str, type[nn.Module]] = {
    "ai_imu": AIIMU,
    "airio": AirIO,
    "ctin": CTIN,
    "deepils": DeepILS,
    "experts": Experts,
    "gnio": GNIO,
    "gru": GRUNetwork,
    "imot": IMoT,
    "imot_text": IMoTText,
    "ionet": IONet,
    "ionext": IONext,
    "ridi": RIDI,
    "ronin_lstm": RoNINLSTM,
    "ronin_resnet": RoNINResNet,
    "ronin_tcn": RoNINTCN,
    "state_space": StateSpaceNetwork,
    "tlio": TLIO,
    "trunk": Trunk,
}
_PUBLISHED = frozenset(_MODELS)

_EQUIVARIANT: dict[str, Callable[..., nn.Module]] = {
    "four_headings": FourHeadings,
    "canonical_frame": CanonicalFrame,
    "device_heading": DeviceHeading,
    "o2_frame": EqNIO,
    "so2_frame": functools.partial(EqNIO, reflections=False, frame_width=128),
    "so2_frame_shallow": functools.partial(EqNIO, reflections=False, depth=1, frame_width=128),
}
_EQUIVARIANT_WITH_MEMORY: dict[str, Callable[..., nn.Module]] = {
    "four_headings": FourHeadingsWithMemory,
    "device_heading": show_device_heading,
}


def names() -> list[str]:
    """Names of the networks that `create` knows, with those of plugins."""
    plugins.load()
    return sorted(_MODELS)


def register(name: str, network: type[nn.Module]) -> None:
    """Make your own network known to `create`, and so to configurations and command lines.

    `network(**options).apply(variables, windows, train=False)` must give a `Prediction`. Its fields
    are its options. The names of its modules say what trains through the filter and what inference
    folds: docs/networks.md has them. A second registration replaces the first. Raises `InputError`
    for the name of a network of this package, and for anything but a class of Flax modules.
    """
    if not (isinstance(network, type) and issubclass(network, nn.Module)):
        remedy = "give the class itself, not one of its modules or a function"
        raise InputError(f"model '{name}'", "is no class of Flax modules", remedy)
    if name in _PUBLISHED:
        raise InputError(f"model '{name}'", "is a network of gnio-jax", "choose another name")
    _MODELS[name] = network


def options(name: str, equivariance: str = "none") -> dict[str, Any]:
    """The options of the network `name`, with those of its equivariance, and their types. Raises
    `InputError` for an unknown name."""
    if name not in _MODELS:
        _check_word(name, names(), f"model '{name}'", "unknown", "models", "; plugins add others")
    network = _MODELS[name]
    types = get_type_hints(network, include_extras=True)
    fields = [field for field in dataclasses.fields(network) if field.metadata.get("option", True)]
    kinds = {field.name: types[field.name] for field in fields}
    kinds |= {"equivariance": Literal["none", *_EQUIVARIANT]}
    kinds |= {"corrector": Literal["none", "airimu"]}
    kinds |= frame_options(equivariance)
    return {option: kind for option, kind in kinds.items() if option not in ("parent", "name")}


def frame_options(equivariance: str) -> dict[str, Any]:
    """The options of an equivariance and their types: the fields of its module that have bounds."""
    construction: Any = _EQUIVARIANT.get(str(equivariance))
    module = getattr(construction, "func", construction)
    types = get_type_hints(module, include_extras=True) if module else {}
    return {option: kind for option, kind in types.items() if get_origin(kind) is Annotated}


def from_config(config: ModelConfig) -> nn.Module:
    """The network that these settings describe; options that are not set take the network's own
    defaults."""
    values = {**vars(config), **config.options}
    del values["options"]
    return create(**{option: value for option, value in values.items() if value is not None})


def from_experiment(config: TrainConfig, source: str = "config") -> nn.Module:
    """The network of an experiment. Raises `InputError` naming `source` for options that it does
    not have, and for windows and measurements that it does not take."""
    model = from_config(config.model)
    check_experiment(model, config, source)
    return model


def check_experiment(model: nn.Module, config: TrainConfig, source: str = "config") -> None:
    """Check that a network can see the windows of an experiment, and that the filter measures what
    the network predicts. Raises `InputError` naming `source` and the field."""
    location, name = Location(source), config.model.name
    network = innermost(model)
    if config.data.context and not getattr(network, "takes_context", True):
        remedy = "its targets are of every sample it sees: set it to 0"
        location.child("data.context_seconds").refuse(f"is not for {name}", remedy)
    rotation = location.child("data.window_rotation")
    in_filter = location.child("filter.window_rotation")
    if channels(model) == 12:
        subject = f"{name}, its equivariance or its corrector sees the body"
        hidden = ("hidden_axes",) if getattr(model, "hides_axes", False) else ()
        if config.data.window_rotation not in ("body_axes", *hidden):
            rotation.refuse(f"must be {' or '.join(('body_axes', *hidden))}: {subject}")
        if config.filter.window_rotation not in (None, "body_axes", *hidden):
            in_filter.refuse(f"must be {' or '.join(('null', *hidden))}: {subject}")
    else:
        for field, setting in ((rotation, config.data), (in_filter, config.filter)):
            value = setting.window_rotation
            if value in ("single", "tlio") and isinstance(model, NetworkWithMemory):
                problem = f"is {value}, and {name} rotates every sample with its own attitude"
                field.refuse(problem, "leave it out")
            if value in ("body_axes", "hidden_axes"):
                field.refuse(f"is {value}, which {name} does not see", "leave it out")
    if config.filter.measures not in quantities(model):
        problem = f"is {config.filter.measures}, which {name} does not predict"
        location.child("filter.measures").refuse(problem, f"known: {', '.join(quantities(model))}")


def innermost(model: nn.Module) -> nn.Module:
    """The network inside an equivariant construction or after a corrector, or the network
    itself."""
    while isinstance(inner := getattr(model, "network", None), nn.Module):
        model = inner
    return model


def quantities(model: nn.Module) -> tuple[Quantity, ...]:
    """What a filter can measure of a network, by its attribute `quantities`."""
    return getattr(innermost(model), "quantities", ("displacement",))


def trained_by(model: nn.Module) -> str:
    """How a network is trained, by its attribute `trained_by`: "gradient", or the name of a method
    of its own (`training.loop.METHODS`)."""
    return getattr(innermost(model), "trained_by", "gradient")


def fitted_options(model: nn.Module) -> tuple[str, ...]:
    """The options that a network's training sets, by its attribute `fitted_options`."""
    return getattr(innermost(model), "fitted_options", ())


def create(name: str, **values: Any) -> nn.Module:
    """The network `name` with its options set; its `apply(variables, windows)` returns a
    `Prediction`.

    `equivariance` is an option of all: "none", "four_headings", "canonical_frame",
    "device_heading" (`models.equivariance`), or a frame of EqNIO (`models.eqnio`), each with the
    options of its module; so is `corrector`: "none" or "airimu" (`models.airimu`). `winograd`, the
    way of computing convolutions in training, is chosen for this machine unless it is given
    (`models.convolution`). Raises `InputError` for an unknown name or option, naming the known
    ones, a value that is not one of an option's choices or beyond its bounds, or options that do
    not fit together.
    """
    subject, kinds = f"model '{name}'", options(name, values.get("equivariance", "none"))
    for option, value in values.items():
        kind = kinds[_check_word(option, kinds, subject, f"unknown option '{option}'", "options")]
        if get_origin(kind) in (Literal, Annotated):
            values[option] = check_value(kind, value, Location(subject, option))
    if "winograd" in kinds:
        values.setdefault("winograd", winograd_pays())
    equivariance, corrector = values.pop("equivariance", "none"), values.pop("corrector", "none")
    of_frame = {
        option: values.pop(option) for option in frame_options(equivariance) & values.keys()
    }
    try:
        network = _MODELS[name](**values)
    except ValueError as error:
        raise InputError(subject, str(error)) from None
    memory, body = isinstance(network, NetworkWithMemory), channels(network) != 6
    if equivariance != "none":
        if body:
            problem = "sees the body, whose axes a frame would not turn"
            raise InputError(subject, problem, "leave model.equivariance out")
        if memory and equivariance not in _EQUIVARIANT_WITH_MEMORY:
            problem = "turns with the world already, by its memory's frame"
            remedy = f"known with it: none, {', '.join(_EQUIVARIANT_WITH_MEMORY)}"
            raise InputError(subject, problem, remedy)
        constructions = _EQUIVARIANT_WITH_MEMORY if memory else _EQUIVARIANT
        network = constructions[equivariance](network=network, **of_frame)
    if corrector != "none":
        if memory:
            problem = "sees single samples, and a corrector needs windows"
            raise InputError(subject, problem, "leave model.corrector out")
        if equivariance != "none":
            problem = "has a frame, before which no corrector can be"
            raise InputError(subject, problem, "leave model.corrector or model.equivariance out")
        network = Corrected(network)
    return network


def channels(model: nn.Module) -> int:
    """Channels of the windows of a network: 6, or 12 with the body's axes."""
    return getattr(model, "channels", 6)


def predicts_displacement(model: nn.Module) -> bool:
    """Whether a network predicts a displacement. One that does not can be trained and run in the
    filter's loop alone, and needs no weights from training on windows."""
    return getattr(innermost(model), "predicts_displacement", True)


def _check_word(
    word: str, words: Iterable[str], where: str, problem: str, title: str, more: str = ""
) -> str:
    """Return `word` if it is among `words`. Else raise `InputError` that names these, the closest
    first."""
    if word not in words:
        remedy = f"{did_you_mean(word, words)}known {title}: {', '.join(words)}{more}"
        raise InputError(where, problem, remedy)
    return word


def initialise(model: nn.Module, key: PRNGKeyArray, window: int = 200) -> Any:
    """Fresh variables of `model` for windows of `window` samples.

    `model.init` gives the same to rounding, but compiling it takes many times as long. Here the
    network is never run, and one small program draws all parameters of one shape.
    """
    return model.lazy_init(key, _windows(model, window))


def variable_shapes(model: nn.Module, window: int = 200) -> Any:
    """The shapes and types of what `initialise` gives; nothing is computed."""
    return _init.eval_shape(model, jax.random.key(0), _windows(model, window))


@functools.partial(jax.jit, static_argnums=0)
def _init(model: nn.Module, key: PRNGKeyArray, windows: Any) -> Any:
    """`model.init`, whose traces JAX keeps, because a run is loaded many times in one process."""
    return model.init(key, windows)


def _windows(model: nn.Module, window: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((1, window, channels(model)), jnp.float32)
