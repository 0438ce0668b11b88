"""Weights of TLIO's ResNet as its checkpoints name them: those that `tests/recorded/tlio_tracker`
was recorded with, and for other windows."""

import numpy as np


def shapes(samples=200):
    """PyTorch's key of every array -> its shape, for windows of `samples`."""
    sizes = {"input_block.0.weight": (64, 6, 7)}

    def norm(name, channels):
        sizes.update(
            {
                f"{name}.{part}": (channels,)
                for part in ("weight", "bias", "running_mean", "running_var")
            }
        )
        sizes[f"{name}.num_batches_tracked"] = ()

    norm("input_block.1", 64)
    for group, (before, channels) in enumerate([(64, 64), (64, 128), (128, 256), (256, 512)]):
        for block in range(2):
            name, inputs = f"residual_groups.{group}.{block}", before if block == 0 else channels
            sizes |= {
                f"{name}.conv1.weight": (channels, inputs, 3),
                f"{name}.conv2.weight": (channels, channels, 3),
            }
            norm(f"{name}.bn1", channels)
            norm(f"{name}.bn2", channels)
            if inputs != channels:
                sizes[f"{name}.downsample.0.weight"] = (channels, inputs, 1)
                norm(f"{name}.downsample.1", channels)
    for name in ("output_block1", "output_block2"):
        sizes[f"{name}.prep1.weight"] = (128, 512, 1)
        norm(f"{name}.bn1", 128)
        for layer, (outputs, inputs) in {
            "fc1": (512, 128 * (-(-samples // 32))),
            "fc2": (512, 512),
            "fc3": (3, 512),
        }.items():
            sizes |= {
                f"{name}.{layer}.weight": (outputs, inputs),
                f"{name}.{layer}.bias": (outputs,),
            }
    return sizes


def weights(samples=200, seed=7):
    """Key -> array. The order of the draws, that of the sorted keys, and every float32 operation
    are part of the recording."""
    rng, arrays = np.random.default_rng(seed), {}
    for key, shape in sorted(shapes(samples).items()):
        if key.endswith("num_batches_tracked"):
            arrays[key] = np.zeros(shape, np.int64)
            continue
        drawn = rng.standard_normal(shape).astype(np.float32)
        if key.endswith("running_var"):
            drawn = 1 + 0.2 * np.tanh(drawn)
        elif key.endswith("running_mean"):
            drawn = 0.1 * drawn
        elif len(shape) == 3:
            drawn = drawn * np.sqrt(2 / (shape[0] * shape[2]))
        elif len(shape) == 2 or "fc" in key:
            drawn = 0.02 * drawn
        else:
            drawn = 1 + 0.1 * drawn if key.endswith("weight") else 0.1 * drawn
        arrays[key] = drawn.astype(np.float32)
    for name, bias in [("output_block1", [1.0, 0, 0]), ("output_block2", [-2, -2, -2.5])]:
        arrays[f"{name}.fc3.weight"] *= 0.05
        arrays[f"{name}.fc3.bias"] += np.array(bias, np.float32)
    return arrays
