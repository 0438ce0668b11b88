"""Seeds of one experiment that are trained together: they share recordings and compiled programs.

One after the other in every dispatch (`InTurn`), or as one program whose leading axis is the seed
(`SideBySide`). What a seed learns is what it learns alone, to rounding.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec

from gnio_jax.scaling import devices
from gnio_jax.training.batch_statistics import estimate_statistics, normalises, statistics_order
from gnio_jax.training.kinds import Training, compiled
from gnio_jax.training.log import Row
from gnio_jax.training.losses import stage
from gnio_jax.training.on_windows import WindowTraining, figures
from gnio_jax.training.step import Progress, TrainState, epoch_order, evaluated, train_steps
from gnio_jax.training.supply import OnDevice
from gnio_jax.training.validation import Validation, calibrated, calibrates, isotropic, validate


@runtime_checkable
class Together(Protocol):
    """Seeds at the same step. One seed is the case of length one."""

    @property
    def trainings(self) -> tuple[Training, ...]:
        """Of each seed."""
        ...

    def joined(self, states: Sequence[TrainState]) -> Any:
        """The states of all seeds, as the functions here take them."""
        ...

    def apart(self, states: Any) -> Sequence[TrainState]:
        """The state of each seed."""
        ...

    def order(self, epoch: int) -> Any:
        """What each seed visits in an epoch. For `take_steps`."""
        ...

    def take_steps(
        self, states: Any, order: Any, first: int, count: int, factors: Sequence[float]
    ) -> tuple[Any, list[Progress]]:
        """Take `count` steps of an epoch with each seed, from its step `first` on. `factors` are
        those of each seed's learning rate. The old states are used up."""
        ...

    def settled(self, states: Any) -> Any:
        """The states as they are validated and kept."""
        ...

    def validate(self, states: Any, step: int) -> tuple[Any, list[Row]]:
        """Settled states as they are kept after `step` steps, and the figures of each."""
        ...


def together(trainings: Sequence[Training]) -> Together:
    """Side by side on GPUs and TPUs, and on several devices; in turn on a CPU, whose cores one seed
    keeps busy, and where only one of a kind can be done: with recordings on the disk, and through
    the filter."""
    several_places = jax.default_backend() != "cpu" or devices.count(devices.SEEDS) > 1
    on_device = [
        training
        for training in trainings
        if isinstance(training, WindowTraining) and isinstance(training.supply, OnDevice)
    ]
    if several_places and len(on_device) == len(trainings) > 1:
        return SideBySide(tuple(on_device), batched=jax.default_backend() != "cpu")
    return InTurn(tuple(trainings))


# One after the other
# ------------------------------------------------------------------------------------------------


class InTurn(NamedTuple):
    """A `Together`: every dispatch of a seed is followed by that of the next one."""

    trainings: tuple[Training, ...]

    def joined(self, states: Sequence[TrainState]) -> list[TrainState]:
        return list(states)

    def apart(self, states: list[TrainState]) -> list[TrainState]:
        return states

    def order(self, epoch: int) -> list[Any]:
        return [training.order(epoch) for training in self.trainings]

    def take_steps(
        self,
        states: list[TrainState],
        order: list[Any],
        first: int,
        count: int,
        factors: Sequence[float],
    ) -> tuple[list[TrainState], list[Progress]]:
        each = zip(self.trainings, states, order, factors, strict=True)
        taken = [
            training.take_steps(state, visited, first, count, factor)
            for training, state, visited, factor in each
        ]
        return [state for state, _ in taken], [progress for _, progress in taken]

    def settled(self, states: list[TrainState]) -> list[TrainState]:
        each = zip(self.trainings, states, strict=True)
        return [training.settled(state) for training, state in each]

    def validate(self, states: list[TrainState], step: int) -> tuple[list[TrainState], list[Row]]:
        each = zip(self.trainings, states, strict=True)
        found = [training.validate(state, step) for training, state in each]
        return [state for state, _ in found], [row for _, row in found]


# One program
# ------------------------------------------------------------------------------------------------


class SideBySide(NamedTuple):
    """A `Together` for training on windows: one program, and states whose leading axis is the seed.

    Several devices share the seeds out among them: each trains its own, and nothing is sent. Where
    they cannot share them evenly, the last seed fills the empty places.
    """

    trainings: tuple[WindowTraining, ...]
    batched: bool
    """Whether the seeds of a device are an axis of the same operations, or take turns in a loop."""

    @property
    def _first(self) -> WindowTraining:
        return self.trainings[0]

    @property
    def _fixed(self) -> dict[str, Any]:
        """What validation and statistics are compiled for."""
        return {"model": self._first.model, "config": compiled(self._first.config)}

    def joined(self, states: Sequence[TrainState]) -> TrainState:
        host = [jax.device_get(state) for state in states]
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *self._filled(host))
        return devices.one_each(stacked)

    def apart(self, states: TrainState) -> list[TrainState]:
        return _rows_of(states, len(self.trainings))

    def order(self, epoch: int) -> jax.Array:
        source = self._first.source
        return self._stacked(
            epoch_order(training.keys.order, epoch, source) for training in self.trainings
        )

    def take_steps(
        self,
        states: TrainState,
        order: jax.Array,
        first: int,
        count: int,
        factors: Sequence[float],
    ) -> tuple[TrainState, list[Progress]]:
        training = self._first
        fixed = {
            "model": training.model,
            "optimizer": training.optimizer,
            "config": compiled(training.config),
            "steps_per_epoch": training.steps_per_epoch,
        }
        given = (order, self._stacked(jnp.float32(each) for each in factors), self._keys("step"))
        shared = (training.source, jnp.int32(first), jnp.int32(count))
        states, progress = self._program(_steps, fixed)(states, given, shared)
        return states, _rows_of(progress, len(self.trainings))

    def settled(self, states: TrainState) -> TrainState:
        """As `WindowTraining.settled`."""
        training = self._first
        if not training.config.optim.statistics_windows or not normalises(states):
            return states
        orders = [
            statistics_order(each.keys.statistics, training.source, training.config)
            for each in self.trainings
        ]
        given = (self._stacked(orders), self._keys("statistics"))
        program = self._program(_statistics, self._fixed)
        estimated = program(evaluated(states), given, (training.source,))
        return states._replace(batch_stats=estimated.batch_stats)

    def validate(self, states: TrainState, step: int) -> tuple[TrainState, list[Row]]:
        """As `WindowTraining.validate`."""
        found = self._errors(states, step)
        if calibrates(states):
            equivariant = self._first.config.model.equivariance != "none"
            fitting = jax.vmap(isotropic)(found) if equivariant else found
            states = jax.vmap(calibrated)(states, fitting)
            found = self._errors(states, step)
        return states, [figures(each) for each in _rows_of(found, len(self.trainings))]

    def _errors(self, states: TrainState, step: int) -> Validation:
        """Means over the validation windows, of each seed."""
        training = self._first
        now = stage(training.config.loss, step - 1, training.steps_per_epoch)
        shared = (training.held_out, now)
        return self._program(_validation, self._fixed)(evaluated(states), (), shared)

    def _program(self, function: Callable[..., Any], fixed: dict[str, Any]) -> Callable[..., Any]:
        mesh = jax.sharding.get_abstract_mesh()
        mesh = None if mesh.empty else mesh
        return over_seeds(function, tuple(fixed.items()), mesh, self.batched)

    def _keys(self, name: str) -> jax.Array:
        return self._stacked(getattr(training.keys, name) for training in self.trainings)

    def _stacked(self, arrays: Any) -> jax.Array:
        return jnp.stack(self._filled(list(arrays)))

    def _filled(self, each: list[Any]) -> list[Any]:
        """The last one once more for every place that has none."""
        places = -(-len(each) // devices.count(devices.SEEDS)) * devices.count(devices.SEEDS)
        return each + each[-1:] * (places - len(each))


@functools.cache
def over_seeds(
    function: Callable[..., Any], fixed: tuple[tuple[str, Any], ...], mesh: Any, batched: bool
) -> Callable[..., Any]:
    """`function(state, given, shared, **fixed)` for every seed, as one program of stacked states,
    stacked `given` and what all seeds share; steps use up the old states.

    The devices of `mesh` share the seeds out among them. Those of one device are `batched` into the
    same operations, or take turns.
    """

    def of_device(states: Any, given: Any, shared: Any) -> Any:
        def of_seed(each: tuple[Any, Any]) -> Any:
            return function(*each, shared, **dict(fixed))

        seeds = (states, given)
        return jax.vmap(of_seed)(seeds) if batched else jax.lax.map(of_seed, seeds)

    program = of_device
    if mesh is not None:
        rows, whole = PartitionSpec(devices.SEEDS), PartitionSpec()
        program = jax.shard_map(
            of_device, mesh=mesh, in_specs=(rows, rows, whole), out_specs=rows, check_vma=False
        )
    return jax.jit(program, donate_argnums=0 if function is _steps else ())


def _steps(state: TrainState, given: Any, shared: Any, **fixed: Any) -> tuple[TrainState, Progress]:
    (order, factor, key), (source, first, count) = given, shared
    return train_steps(state, source, order, first, count, factor, key, **fixed)


def _statistics(state: TrainState, given: Any, shared: Any, **fixed: Any) -> TrainState:
    (order, key), (source,) = given, shared
    return estimate_statistics(state, source, order, key, **fixed)


def _validation(state: TrainState, _given: Any, shared: Any, **fixed: Any) -> Validation:
    source, now = shared
    return validate(state, source, now, **fixed)


def _rows_of(tree: Any, count: int) -> list[Any]:
    """The first rows of stacked arrays, on the host."""
    host = jax.device_get(tree)
    return [jax.tree.map(lambda leaf, k=k: np.asarray(leaf[k]), host) for k in range(count)]
