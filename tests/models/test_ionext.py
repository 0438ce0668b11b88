"""IONext against plain NumPy, kernel by kernel and branch by branch."""

import jax
import numpy as np

from gnio_jax import models
from gnio_jax.models import ionext
from tests.support.networks import drawn, predicted
from tests.support.numpy_layers import batch_norm, float64, linear, sigmoid, softmax


def depthwise(x, q):
    size = len(q["kernel"])
    out = np.zeros_like(x)
    for t in range(len(x)):
        for k in range(size):
            if 0 <= t + k - size // 2 < len(x):
                out[t] += x[t + k - size // 2] * q["kernel"][k, 0]
    return out + q["bias"]


def block(x, q, s):
    y = batch_norm(x, q["mixer_norm"], s["mixer_norm"])
    halves, width = [], x.shape[1] // 2
    for half, sizes in enumerate(((1, 3, 11), (1, 5, 17))):
        part = y[:, half * width : (half + 1) * width]
        scores = linear(part.mean(0), q[f"half{half}_choice"]).reshape(3, width)
        shares = softmax(scores, axis=0)
        branches = (depthwise(part, q[f"half{half}_k{size}"]) for size in sizes)
        halves.append(sum(share * branch for share, branch in zip(shares, branches, strict=True)))
    x = x + linear(np.hstack(halves), q["mixer"])
    y = batch_norm(x, q["gate_norm"], s["gate_norm"])
    gate = sigmoid(linear(np.concatenate([y.mean(0), y.max(0)]), q["gate"]))
    return x + gate * depthwise(y, q["gated"])


def strided(x, q, size):
    rows = range(0, len(x) - size + 1, size)
    return np.array([sum(x[r + k] @ q["kernel"][k] for k in range(size)) for r in rows]) + q["bias"]


def test_forward_against_numpy(monkeypatch):
    """Of one block a stage; 28 samples leave 7, 4, 2 and 1 of them."""
    monkeypatch.setattr(ionext, "DEPTHS", (1, 1, 1, 1))
    model = models.create("ionext", width=6, output_dim=2)
    variables = drawn(models.variable_shapes(model, 28))
    windows = np.random.default_rng(1).standard_normal((2, 28, 6)).astype(np.float32)
    (q, s), displacements = float64(variables), []
    for x in windows.astype(float):
        x = batch_norm(strided(x, q["stem"], 4), q["stem_norm"], s["stem_norm"])
        for stage in range(4):
            if stage:
                x = batch_norm(x, q[f"down{stage}_norm"], s[f"down{stage}_norm"])
                x = strided(np.vstack([x, x[-1:]])[: len(x) + len(x) % 2], q[f"down{stage}"], 2)
            name = f"stage{stage + 1}_block1"
            x = block(x, q[name], s[name])
        h = batch_norm(x, q["last_norm"], s["last_norm"]).mean(0)
        displacements.append([*linear(h, q["displacement"]), 0])
    size = np.abs(displacements).max()
    for prediction in predicted(model, variables, windows, False):
        np.testing.assert_allclose(prediction.displacement, displacements, atol=1e-5 * max(size, 1))
    jax.clear_caches()  # of a network with fewer blocks
