# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # A walk and its filter
#
# One simulated walk, from its samples to a trajectory: the recording, the windows that the network
# sees, the displacements that it predicts, and the filter that fuses them. Nothing is downloaded.
# It takes two minutes on two CPU cores, most of them for the training of a small network.

# %%
import dataclasses
import tempfile

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from gnio_jax import config, data, evaluation, filtering, geometry, networks
from gnio_jax.training import loop
from gnio_jax.training.windows import gather, window_source

jax.config.update("jax_enable_x64", True)  # the filter runs in float64, the network in float32

# %% [markdown]
# ## The recording
#
# A person with the phone in the hand, 120 s. A `Sequence` has the IMU and the reference on one
# clock. We bring it to 100 Hz, the rate of the network below.

# %%
walk = data.resample(data.load("synthetic", split="test")[0], 100.0)
print(walk.name, walk.attributes["placement"], f"{walk.time[-1] - walk.time[0]:.0f} s")

rows = slice(3000, 3400)
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.5))
left.plot(walk.time[rows], walk.accel[rows], label=["x", "y", "z"])
left.set(xlabel="time (s)", ylabel="specific force, body frame (m/s²)")
left.legend(ncols=3)
right.plot(*walk.position[:, :2].T, color="grey")
right.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title="true path")
figure.tight_layout()

# %% [markdown]
# The accelerometer measures gravity and steps, in the axes of the phone. If one integrates this
# twice, the result soon leaves the path.
#
# ## The windows
#
# The network sees one second at a time, rotated so that gravity lies on z and the start has zero
# yaw: seen from above, the phone's x axis points along x. In this frame it does not matter where
# the walker goes.

# %%
experiment = config.load("quickstart")
windows = experiment.data
source = window_source([walk], windows, windows.stride)
which = jnp.arange(len(source.start))
batch = gather(source, which, windows.window)
print(batch.imu.shape, "windows, samples, [accel, gyro]")

number = 400
begin = int(source.start[number])
time = np.arange(windows.window) / windows.rate
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.5), sharey=True)
left.plot(time, walk.accel[begin : begin + windows.window], label=["x", "y", "z"])
left.set(title="body frame", xlabel="time (s)", ylabel="specific force (m/s²)")
right.plot(time, batch.imu[number, :, :3], label=["x", "y", "z, up"])
right.set(title="the network's frame", xlabel="time (s)")
left.legend()
right.legend()
print("moved in this second:", np.asarray(batch.displacement[number]).round(2), "m")

# %% [markdown]
# ## The network
#
# A small network learns from other walkers, with an eighth of the paper's width and ten epochs. If
# you have a trained network, `run = gnio_jax.load_pretrained(NAME)` takes the place of this cell.

# %%
workdir = tempfile.mkdtemp()
small = dataclasses.replace(
    experiment,
    workdir=workdir,
    model=dataclasses.replace(experiment.model, width=8),
    optim=dataclasses.replace(experiment.optim, epochs=10, statistics_windows=2048),
)
small = dataclasses.replace(small, data=dataclasses.replace(windows, train_stride_seconds=0.2))
loop.train(small)
run = networks.load(workdir)

# %% [markdown]
# It predicts a displacement and the logarithm of its standard deviation, in the frame of each
# window.

# %%
prediction = jax.jit(run.model.apply)(run.variables, batch.imu)
figure, axes = plt.subplots(1, 3, figsize=(11, 3.6))
for axis, name, panel in zip(range(3), ["x", "y", "z, up"], axes, strict=True):
    true, predicted = batch.displacement[:, axis], prediction.displacement[:, axis]
    panel.errorbar(
        true, predicted, jnp.exp(prediction.log_std[:, axis]), fmt=".", ms=3, lw=0.3, alpha=0.5
    )
    ends = [float(true.min()), float(true.max())]
    panel.plot(ends, ends, color="black", lw=1)
    panel.set(xlabel="true (m)", title=name)
axes[0].set_ylabel("predicted (m)")
figure.tight_layout()
error = jnp.sqrt(jnp.mean((prediction.displacement - batch.displacement) ** 2, axis=0))
print("root mean square error of a second:", np.asarray(error).round(3), "m")

# %% [markdown]
# ## The filter
#
# The filter cuts the windows itself, with its own attitude and biases, asks the network at every
# tenth of a second, and fuses the answer with the integrated IMU: one program. It starts from the
# true pose here; `gnio track` starts from gravity.

# %%
ekf = filtering.make_filter(run.config.data, run.config.filter)
rotation = geometry.matrix_from_quaternion(jnp.asarray(walk.orientation[0]))
start = filtering.initial_state(ekf, rotation, walk.velocity[0], walk.position[0])
n = ekf.config.samples_per_clone
whole = (len(walk.time) - 1) // n * n


@jax.jit
def odometry(variables, gyro, accel):
    return filtering.run_odometry(
        lambda imu: run.model.apply(variables, imu),
        ekf,
        start,
        gyro,
        accel,
    )


_, history = odometry(run.variables, walk.gyro[:whole], walk.accel[:whole])
truth = walk.position[n : whole + 1 : n]
print("positions:", history.position.shape)
print("displacements in the first two seconds:", np.isfinite(history.displacement[:20, 0]).sum())

# %% [markdown]
# The first window is complete after a second. Before that there is no displacement, and the filter
# integrates the IMU alone.

# %%
std = jnp.sqrt(history.covariance_diagonal[:, 6:9])
time = n / windows.rate * np.arange(1, len(truth) + 1)
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4))
left.plot(*truth[:, :2].T, color="grey", label="true")
left.plot(*history.position[:, :2].T, label="filter")
left.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
left.legend()
for axis, name in enumerate("xy"):
    (line,) = right.plot(time, history.position[:, axis] - truth[:, axis], label=f"error in {name}")
    right.fill_between(
        time, -3 * std[:, axis], 3 * std[:, axis], color=line.get_color(), alpha=0.15
    )
right.set(xlabel="time (s)", ylabel="m", title="error, and three standard deviations")
right.legend()
figure.tight_layout()

# %% [markdown]
# The band shows the errors that the filter expects. `NIS / 3` compares the errors of the
# displacements with their covariance: 1 is consistent. If it is smaller, the factor of 10 on the
# network's covariance is too large. `gnio calibrate` fits it ([Read the tables](../tables.md)).

# %%
ate = evaluation.metrics.ate(np.asarray(history.position), truth)
print(f"ATE {ate:.2f} m, NIS / 3 {np.nanmean(history.nis) / 3:.2f}")
print(f"accepted {np.nanmean(history.accepted):.0%}")
