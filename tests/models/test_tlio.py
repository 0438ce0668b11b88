"""RoNIN's network, which has TLIO's encoder and head, against the recorded output of TLIO's."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from gnio_jax import interop, models
from gnio_jax.models.tlio import FullyConnectedHead
from tests.support import tlio_weights
from tests.support.compiling import quick
from tests.support.networks import predicted

RECORDED = Path(__file__).parents[1] / "recorded" / "tlio_tracker" / "pipeline.npz"


def test_ronins_displacement_is_that_of_tlio_with_the_same_weights():
    """Of two axes; the vertical is 0, and the uncertainty a constant."""
    recorded = np.load(RECORDED, allow_pickle=False)
    gyro, accel = np.split(recorded["net_input_gyro_accel"], 2, axis=-1)
    tlio = interop.load_tlio_state_dict(tlio_weights.weights())
    variables = {
        kind: {name: part for name, part in tree.items() if name != "log_std"}
        for kind, tree in tlio.items()
    }
    head = variables["params"]["displacement"]
    fc3 = {name: array[..., :2] for name, array in head["fc3"].items()}
    variables["params"]["displacement"] = head | {"fc3": fc3}
    constant = np.array([-1.0, -2.0, -3.0], np.float32)
    variables["batch_stats"]["uncertainty"] = {"log_std": constant}
    model = models.create("ronin_resnet", output_dim=2)
    displacements = recorded["net_displacement"] * [1, 1, 0]
    for prediction in predicted(model, variables, np.concatenate([accel, gyro], axis=-1)):
        np.testing.assert_allclose(prediction.displacement, displacements, atol=1e-5)
        np.testing.assert_array_equal(
            prediction.log_std, np.tile(constant, (len(displacements), 1))
        )


def test_a_new_head_predicts_next_to_nothing():
    features = jnp.float32(np.random.default_rng(1).standard_normal((8, 2, 64)))
    head = FullyConnectedHead(8, 3, 0.5)
    output, variables = quick(lambda key: head.init_with_output(key, features, False))(
        jax.random.key(0)
    )
    assert np.abs(output).max() < 0.1
    params = jax.device_get(variables["params"])
    assert abs(params["fc1"]["kernel"].std() - 0.01) < 0.001
    assert not any(params[layer]["bias"].any() for layer in ("fc1", "fc2", "fc3"))
