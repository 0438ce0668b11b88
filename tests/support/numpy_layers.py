"""Layers in plain NumPy, for one window at a time: direct sums, no matrix tricks. `q` are the
parameters of a layer, `s` its statistics."""

import math

import jax
import numpy as np


def float64(variables):
    """Parameters and statistics."""
    whole = jax.tree.map(lambda x: np.asarray(x, np.float64), variables)
    return whole["params"], whole["batch_stats"]


def linear(x, q):
    return x @ q["kernel"] + q.get("bias", 0)


def relu(x):
    return np.maximum(x, 0)


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def softmax(x, axis=-1):
    e = np.exp(x - x.max(axis=axis, keepdims=True))
    return e / e.sum(axis=axis, keepdims=True)


def layer_norm(x, q):
    spread = np.sqrt(x.var(-1, keepdims=True) + 1e-5)
    return (x - x.mean(-1, keepdims=True)) / spread * q["scale"] + q["bias"]


def conv(x, kernel, stride=1, padding=0):
    x, size = np.pad(x, ((padding, padding), (0, 0))), len(kernel)
    rows = range(0, len(x) - size + 1, stride)
    return np.array([sum(x[r + k] @ kernel[k] for k in range(size)) for r in rows])


def batch_norm(x, q, s):
    return (x - s["mean"]) / np.sqrt(s["var"] + 1e-5) * q["scale"] + q["bias"]


def conv_norm(x, name, q, s, stride=1, padding=0):
    """The convolution `name` and its normalisation."""
    norm = name.replace("conv", "bn")
    return batch_norm(conv(x, q[name]["kernel"], stride, padding), q[norm], s[norm])


def resnet(x, q, s, block):
    """Stem, max-pool and four groups of two blocks `block(x, q, s, stride)`."""
    x = relu(conv_norm(x, "stem_conv", q, s, 2, 3))
    x = np.array([x[max(0, r - 1) : r + 2].max(axis=0) for r in range(0, len(x), 2)])
    for group in range(4):
        for number in range(2):
            name = f"group{group + 1}_block{number + 1}"
            x = block(x, q[name], s[name], 2 if group and not number else 1)
    return x


def attention(query, key, value, q, causal=False):
    """Step by step, head by head; causal: a step sees no later one."""
    out = np.zeros((len(query), q["out"]["kernel"].shape[-1])) + q["out"]["bias"]
    for h in range(q["query"]["kernel"].shape[1]):
        a, b, c = (
            x @ q[name]["kernel"][:, h] + q[name]["bias"][h]
            for name, x in (("query", query), ("key", key), ("value", value))
        )
        for i in range(len(a)):
            horizon = i + 1 if causal else len(b)
            weights = softmax(b[:horizon] @ a[i] / np.sqrt(a.shape[1]))
            out[i] += weights @ c[:horizon] @ q["out"]["kernel"][h]
    return out


def motion_bank(feature, q):
    """Context of one feature, and its attention (heads, prototypes)."""
    context, attention = [], []
    for head in range(q["query"]["bias"].shape[0]):
        query, key, value = (
            rows @ q[name]["kernel"][:, head] + q[name]["bias"][head]
            for name, rows in zip(
                ("query", "key", "value"), (feature, q["prototypes"], q["prototypes"]), strict=True
            )
        )
        attention.append(softmax(key @ query / np.sqrt(len(query))))
        context.append(attention[-1] @ value)
    output = q["output"]["kernel"].reshape(len(feature), len(feature))
    return np.concatenate(context) @ output + q["output"]["bias"], np.array(attention)


def gelu(x):
    return np.array([0.5 * v * (1 + math.erf(v / math.sqrt(2))) for v in x.flat]).reshape(x.shape)


def recurrence(x, q, cell, reverse=False):
    """An LSTM or GRU step by step: the outputs, and the one that came last."""
    units = len(q["recurrent_kernel"])
    h, c, outputs = np.zeros(units), np.zeros(units), [None] * len(x)
    for t in reversed(range(len(x))) if reverse else range(len(x)):
        a = x[t] @ q["input"]["kernel"] + q["input"]["bias"]
        b = h @ q["recurrent_kernel"] + q["recurrent_bias"]
        gate = [(a[k : k + units], b[k : k + units]) for k in range(0, len(a), units)]
        if cell == "lstm":
            i, f, g, o = (u + v for u, v in gate)
            c = sigmoid(f) * c + sigmoid(i) * np.tanh(g)
            h = sigmoid(o) * np.tanh(c)
        else:
            r, z = (sigmoid(u + v) for u, v in gate[:2])
            h = (1 - z) * np.tanh(gate[2][0] + r * gate[2][1]) + z * h
        outputs[t] = h
    return np.array(outputs), h


def both_ways(x, q, cell):
    forward, backward = (
        recurrence(x, q[name], cell, name == "backward") for name in ("forward", "backward")
    )
    return tuple(np.concatenate(pair, axis=-1) for pair in zip(forward, backward, strict=True))
