# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Learning through the filter
#
# The filter is differentiable. This notebook takes the gradient of the likelihood of its
# innovations with respect to the noise model, checks it against a difference quotient, and learns
# the noises in some steps. It takes a minute on a CPU.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

from gnio_jax import data, filtering, geometry

jax.config.update("jax_enable_x64", True)  # the filter runs in float64

# %% [markdown]
# ## A walk with known noises
#
# We add white noise to the IMU of a simulated walk, so we know what the filter should find. The
# true displacements with an error of 2 cm take the place of a network.

# %%
SECONDS = 30
RATE, SAMPLES, CLONES = 100, 10, 10
walk = data.resample(data.load("synthetic", split="test")[0], float(RATE))
rng = np.random.default_rng(0)
n = RATE * SECONDS
true_density = np.array([5e-3, 1e-1])  # of gyro and accelerometer, rad/s/√Hz and m/s²/√Hz
gyro, accel = (
    signal[:n] + density * np.sqrt(RATE) * rng.standard_normal((n, 3))
    for signal, density in zip([walk.gyro, walk.accel], true_density, strict=True)
)

rotation = jax.vmap(geometry.matrix_from_quaternion)(jnp.asarray(walk.orientation))
clones = np.arange(0, n + 1, SAMPLES)
moved = walk.position[clones[CLONES:]] - walk.position[clones[:-CLONES]]
old_yaw = jax.vmap(geometry.yaw_rotation)(rotation[clones[:-CLONES]])
std = 0.02
displacement = np.full((n // SAMPLES, 3), np.nan)  # NaN: no measurement in the first second
displacement[CLONES - 1 :] = np.einsum("kji,kj->ki", old_yaw, moved)
displacement += std * rng.standard_normal(displacement.shape)
covariance = np.tile(std**2 * np.eye(3), (len(displacement), 1, 1))

# %% [markdown]
# ## A loss, and its gradient
#
# The likelihood of the innovations needs no reference. It is low if the noises are too small for
# the innovations, and also if they are too large. We learn logarithms, so that noises stay
# positive.

# %%
settings = filtering.FilterConfig(
    dt=1 / RATE,
    samples_per_clone=SAMPLES,
    clones_per_window=CLONES,
    gate_softness=2.0,  # a gate with a slope
)
std_of_start = filtering.InitialStd(accel_bias=0.2)  # a phone's bias, which is no noise
start = filtering.initial_state(
    filtering.Filter(settings, start=std_of_start), rotation[0], walk.velocity[0], walk.position[0]
)


def loss(log_density):
    gyro_density, accel_density = jnp.exp(log_density)
    noise = filtering.NoiseModel(
        gyro_density,
        accel_density,
        measurement_scale=1.0,  # the errors of these displacements are white
    )
    _, history = filtering.run_filter(
        filtering.Filter(settings, noise), start, gyro, accel, displacement, covariance
    )
    return -jnp.nanmean(history.log_likelihood)


value_and_gradient = jax.jit(jax.value_and_grad(loss))
log_density = jnp.log(jnp.asarray(filtering.NoiseModel()[:2]))  # TLIO's values
value, gradient = value_and_gradient(log_density)
print(f"loss {value:.3f}, gradient {np.asarray(gradient).round(4)}")

# %% [markdown]
# A difference quotient gives the same.

# %%
step = 1e-4
for k, name in enumerate(["gyro", "accelerometer"]):
    up, down = (value_and_gradient(log_density.at[k].add(s))[0] for s in (step, -step))
    print(f"{name}: {(up - down) / (2 * step):.4f}")

# %% [markdown]
# ## Some steps of learning

# %%
STEPS = 150
optimizer = optax.adam(0.1)
state = optimizer.init(log_density)
path, losses = [np.exp(log_density)], []
for _ in range(STEPS):
    value, gradient = value_and_gradient(log_density)
    update, state = optimizer.update(gradient, state)
    log_density = optax.apply_updates(log_density, update)
    path.append(np.exp(log_density))
    losses.append(float(value))

path = np.array(path)
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.6))
left.plot(losses)
left.set(xlabel="step", ylabel="- log-likelihood of an innovation")
for k, name in enumerate(["gyro", "accelerometer"]):
    (line,) = right.semilogy(path[:, k], label=name)
    right.axhline(true_density[k], color=line.get_color(), ls=":")
right.set(xlabel="step", ylabel="density", title="learnt, and what was added (dotted)")
right.legend()
figure.tight_layout()
print("learnt / added:", (path[-1] / true_density).round(2))

# %% [markdown]
# The noises begin 16 and 100 times too small and end within a quarter of what we added (dotted).
# Thirty seconds of one walk do not determine them better, because a wrong tilt at the start and a
# drifting gyro have similar effects. More recordings do, side by side with `jax.vmap`.
#
# The same gradient reaches the start, the displacements and the parameters of a network:
# [The differentiable filter](../differentiable_filter.md).
