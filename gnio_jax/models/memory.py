"""Networks with memory: they see each sample once and carry a state from interval to interval, so
that a displacement may depend on minutes of walking (ours; the networks are in files of their own).

The samples are expressed in a frame F with gravity on z, whose yaw is carried with the memory. With
the attitude R_m that the filter has at sample m, its biases b and the yaw rotation F → world R_F,

    x_m = R_Fᵀ R_m [accel_m − b_a, gyro_m − b_g].

At the first step R_F is the yaw rotation of the attitude, so that the memory begins with zero yaw.
Between two steps the filter corrects its attitude, from R to exp(δ) R. Then R_F turns with it, by
the turn about z in exp(δ) = Rz S, where S is a tilt (`geometry.twist_direction`), and

- neither the samples nor the memory show a step of the yaw, since R_Fᵀ R_m changes only by the
  corrected tilt. The gyro tells the turn between neighbouring samples far better than an update
  tells the yaw of the world, so recent samples remain consistent with each other. Samples of the
  past are off by the yaw that has drifted since then, as they would be in any frame;
- a turn of the whole world turns R_F, and neither samples nor memory change: the displacement in
  the world turns by the same angle, exactly, whatever the network;
- the frame has the error of the filter's own yaw at present. A displacement in F is therefore
  measured as one of a window that was cut with the filter's attitude (docs/networks_with_memory.md
  has the derivation).

Corrected biases hold from the next sample on, and the memory keeps what it has seen.
"""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax import geometry
from gnio_jax.config.schema import NonNegativeCount, Positive
from gnio_jax.models.bins import BinHead
from gnio_jax.models.heads import UNCERTAINTIES, GatedHead, LinearHead
from gnio_jax.models.layers import check_windows, checked_windows
from gnio_jax.models.motion_bank import MotionBank
from gnio_jax.types import GRAVITY, Memory, Prediction


class NetworkWithMemory(nn.Module):
    """The common part of all networks with memory: an encoder that continues from its state, and
    GNIO's Motion Bank and heads on its features.

    A network defines `begin`, `encode`, and the number of samples of which an interval must be a
    multiple. `advance` is the network over any number of intervals, one or a whole recording, with
    the same results to rounding. On windows (b, n, 6), as every other network takes them, it begins
    with an empty memory at each window's start.

    `bank_size = 0` leaves the bank out. Training needs the random stream `dropout` if the network
    has dropout. The head "bins" has the uncertainty of its distribution over bins from −`reach` to
    `reach` m, in the place of `uncertainty`.
    """

    bank_size: NonNegativeCount = 0
    bank_std: Positive = 1.0
    head: Literal["gated", "linear", "bins"] = "linear"
    gate: Literal["tanh", "sigmoid"] = "tanh"
    scale: Literal["softplus", "pos_elu", "abs", "exp", "linear"] = "softplus"
    uncertainty: Literal["head", "calibrated", "constant"] = "head"
    reach: Positive = 3.0
    inputs: int = dataclasses.field(default=6, metadata={"option": False})
    """Channels that the encoder sees, and for which `begin` makes its state: accel, gyro, and
    vectors that an equivariance adds to them (`equivariance.DeviceHeadingWithMemory`)."""

    channels = 6
    """Channels of the samples."""

    def begin(self, batch: int) -> Any:
        """The state before the first sample: a tree of float32 arrays with `batch` rows."""
        raise NotImplementedError

    def encode(
        self, state: Any, signals: Float[Array, "b t c"], train: bool
    ) -> tuple[Any, Float[Array, "b m d"]]:
        """The state after the signals, and features at m times that are spaced evenly, the last one
        at the end; gravity is taken off. It is called inside `advance` and may create modules."""
        raise NotImplementedError

    @property
    def features(self) -> int:
        """Number d of features."""
        raise NotImplementedError

    @property
    def multiple(self) -> int:
        """An interval must have a multiple of this number of samples."""
        return 1

    def __call__(
        self, windows: Float[Array, "b n c"], train: bool = False, **constants: Any
    ) -> Prediction:
        check_windows(windows, self.channels)
        count, samples, _ = windows.shape
        _, prediction = self.advance(self.begin(count), windows, samples, train, **constants)
        return jax.tree.map(lambda leaf: leaf[:, -1], prediction)

    @nn.compact
    def advance(
        self,
        state: Any,
        signals: Float[Array, "b t c"],
        every: int,
        train: bool = False,
        bank: Any = None,
    ) -> tuple[Any, Prediction]:
        """The state after k intervals of `every` samples, and the prediction (b, k, ...) at the end
        of each. The signals are [accel, gyro] in a frame with gravity on z. Raises `ValueError` if
        the intervals do not fit the network's strides."""
        signals = checked_windows(signals, self.inputs)
        batch, samples, _ = signals.shape
        if every % self.multiple or samples % every:
            problem = f"found {samples} samples in intervals of {every}"
            raise ValueError(f"intervals must be multiples of {self.multiple} samples, {problem}")
        gravity = jnp.zeros(self.inputs, jnp.float32).at[2].set(GRAVITY)
        state, h = self.encode(state, signals - gravity[None, None], train)
        intervals = samples // every
        h = h.reshape(batch, intervals, -1, self.features)[:, :, -1].reshape(-1, self.features)
        diagnostics: dict[str, Array] = {}
        if self.bank_size:
            context, diagnostics["attention"] = self._bank(name="bank")(h, bank)
            h = h + context
        displacement, head_diagnostics = self.displacement_head()(h)
        if "log_std" in head_diagnostics:
            log_std = head_diagnostics.pop("log_std")
        else:
            log_std = self.uncertainty_head()(h, train)
        prediction = Prediction(displacement, log_std, diagnostics | head_diagnostics)
        return state, jax.tree.map(
            lambda leaf: leaf.reshape(batch, intervals, *leaf.shape[1:]), prediction
        )

    @nn.nowrap
    def displacement_head(self) -> nn.Module:
        """As in GNIO: a module named "head"."""
        gated, bins = partial(GatedHead, self.gate, self.scale), partial(BinHead, reach=self.reach)
        return {"gated": gated, "linear": LinearHead, "bins": bins}[self.head](name="head")

    @nn.nowrap
    def uncertainty_head(self) -> nn.Module:
        """As in GNIO: a module named "uncertainty"."""
        return UNCERTAINTIES[self.uncertainty](name="uncertainty")

    @nn.nowrap
    def _bank(self, name: str | None = None) -> MotionBank:
        heads = math.gcd(MotionBank.heads, self.features)
        return MotionBank(self.bank_size, heads, self.features, self.bank_std, name=name)

    @nn.nowrap
    def constants(self, variables: Any) -> dict[str, Any]:
        """Arguments of `advance` that depend on the variables alone: the bank's keys and values."""
        if not self.bank_size:
            return {}
        bank = {"params": variables["params"]["bank"]}
        return {"bank": self._bank().apply(bank, method="memory")}


def begin(model: NetworkWithMemory, variables: Any, dtype: Any = float) -> Memory:
    """An empty memory, whose frame has a type of its own (float64 in the filter)."""
    state: Any = model.apply(variables, 1, method="begin")
    return Memory(
        jax.tree.map(lambda leaf: leaf[0], state),
        heading=jnp.zeros(2, dtype),
        attitude=jnp.eye(3, dtype=dtype),
        intervals=jnp.int32(0),
    )


def step(
    model: NetworkWithMemory,
    variables: Any,
    memory: Memory,
    samples: Float[Array, "n c"],
    attitude: Float[Array, "3 3 n+1"],
    **constants: Any,
) -> tuple[Memory, Prediction]:
    """The memory after the n samples of one interval, and the displacement over the last window,
    in the frame of this memory. Jittable and differentiable.

    samples: [accel m/s², gyro rad/s] in the body, without biases, and the body's x and y axes after
    them for a network of 12 channels; attitude: body → world at each sample and at the end of the
    interval. constants: those of the network.
    """
    after = advance_frame(memory, attitude)
    signals = express_samples(after.heading, samples, attitude)
    state, prediction = advance_interval(model, variables, memory.network, signals, **constants)
    return after._replace(network=state), prediction


def advance_frame(memory: Memory, attitude: Float[Array, "3 3 m"]) -> Memory:
    """The memory after an interval with these attitudes, as in `step`, but with the network's state
    of before: its frame has turned with the filter's correction."""
    heading = turned_heading(memory, attitude[:, :, 0])
    return Memory(memory.network, heading, attitude[:, :, -1], memory.intervals + 1)


def express_samples(
    heading: Float[Array, "2"], samples: Float[Array, "n c"], attitude: Float[Array, "3 3 n+1"]
) -> Float[Array, "n c"]:
    """The samples of one interval, as in `step`, in the frame with this heading."""
    count, channels = samples.shape
    vectors = samples.reshape(count, -1, 3).transpose(2, 1, 0)
    vectors = geometry.matmul(attitude[:, :, :-1], vectors).reshape(3, -1)
    vectors = geometry.matmul(geometry.heading_rotation(*heading).T, vectors)
    return vectors.reshape(3, -1, count).transpose(2, 1, 0).reshape(count, channels)


def advance_interval(
    model: NetworkWithMemory,
    variables: Any,
    state: Any,
    signals: Float[Array, "n c"],
    **constants: Any,
) -> tuple[Any, Prediction]:
    """The network's state after one interval, and the displacement over the last window, in the
    frame of the signals. `state` is a tree without a leading axis, as in `Memory`."""
    state = jax.tree.map(lambda leaf: leaf[None], state)
    rows: Any = signals[None].astype(jnp.float32)
    state, prediction = model.apply(
        variables, state, rows, len(signals), method="advance", **constants
    )
    return (
        jax.tree.map(lambda leaf: leaf[0], state),
        jax.tree.map(lambda leaf: leaf[0, 0], prediction),
    )


def turned_heading(memory: Memory, attitude: Float[Array, "3 3"]) -> Float[Array, "2"]:
    """The heading of the memory's frame after the filter has corrected the attitude at the end of
    the last interval to `attitude`; before the first step that of `attitude` itself."""
    correction = geometry.matmul(attitude, memory.attitude.T)
    cosine, sine = geometry.twist_direction(correction)
    x, y = memory.heading
    turned = jnp.stack([cosine * x - sine * y, sine * x + cosine * y])
    first = jnp.stack(geometry.yaw_direction(attitude))
    return jnp.where(memory.intervals > 0, turned, first)
