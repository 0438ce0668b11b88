"""TLIO's weights from every form they come in, mistakes, and the run made of them."""

import functools
import re
import sys

import jax
import numpy as np
import pytest

from gnio_jax import interop, models
from gnio_jax.commands import app
from gnio_jax.config import DataConfig, FilterSettings
from gnio_jax.errors import InputError
from gnio_jax.filtering import make_filter
from gnio_jax.networks import folder, read_network
from tests.support import tlio_weights

WEIGHTS = tlio_weights.weights()


def equal(variables, expected):
    assert jax.tree.structure(variables) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, variables, expected)


@pytest.fixture(scope="module")
def loaded():
    return interop.load_tlio_state_dict(WEIGHTS)


def test_an_npz_holds_the_same(tmp_path, loaded):
    doubled = {
        f"module.{key}": value.astype(np.float64) if value.shape else value
        for key, value in WEIGHTS.items()
    }
    np.savez(tmp_path / "weights.npz", **doubled)
    equal(interop.load_tlio_state_dict(tmp_path / "weights.npz"), loaded)
    equal(interop.load_tlio_state_dict({"model_state_dict": WEIGHTS, "epoch": 3}), loaded)


def tensors():
    """PyTorch, and the weights as a network of it gives them."""
    torch = pytest.importorskip("torch")
    return torch, {key: torch.from_numpy(np.array(value)) for key, value in WEIGHTS.items()}


@pytest.mark.parametrize("form", ["checkpoint", "old format", "parallel", "half precision"])
def test_a_checkpoint_of_pytorch(tmp_path, loaded, form):
    torch, state = tensors()
    if form == "checkpoint":
        adam = torch.optim.Adam([torch.nn.Parameter(torch.zeros(3))], 1e-4).state_dict()
        state = {"model_state_dict": state, "epoch": 7, "optimizer_state_dict": adam}
        state["args"] = {"imu_freq": 200.0}
    elif form == "parallel":
        state = {"model_state_dict": {f"module.{key}": value for key, value in state.items()}}
    elif form == "half precision":
        halved = {key: x.bfloat16() for key, x in state.items() if x.is_floating_point()}
        state = {**state, **halved}
    zipped = {"_use_new_zipfile_serialization": form != "old format"}
    torch.save(state, tmp_path / "checkpoint_7.pt", **zipped)
    variables = interop.load_tlio_state_dict(tmp_path / "checkpoint_7.pt")
    if form == "half precision":
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2**-8), variables, loaded)
    else:
        equal(variables, loaded)


def test_a_torchscript_archive(tmp_path, loaded):
    torch, state = tensors()
    network = torch.nn.Module()
    for key, tensor in state.items():
        *path, name = key.split(".")
        part = network
        for child in path:
            if not hasattr(part, child):
                part.add_module(child, torch.nn.Module())
            part = getattr(part, child)
        part.register_buffer(name, tensor)
    equal(interop.load_tlio_state_dict(network.state_dict()), loaded)
    torch.jit.script(network).save(str(tmp_path / "model_torchscript.pt"))
    equal(interop.load_tlio_state_dict(str(tmp_path / "model_torchscript.pt")), loaded)


class Stranger:
    """Something that only a pickle can hold."""


def test_a_checkpoint_with_more_than_tensors_is_not_run(tmp_path, monkeypatch):
    """Without PyTorch it says how to get it."""
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "torch", None)
        (tmp_path / "a.pth").write_bytes(b"weights")
        with pytest.raises(InputError, match=r"a\.pth: needs the package torch; pip install"):
            interop.load_tlio_state_dict(tmp_path / "a.pth")
    torch = pytest.importorskip("torch")
    torch.save({"model_state_dict": {}, "args": Stranger()}, tmp_path / "checkpoint.pt")
    problem = r"checkpoint\.pt: cannot be read .*tensors and plain values only"
    with pytest.raises(InputError, match=problem):
        interop.load_tlio_state_dict(tmp_path / "checkpoint.pt")


def changed(**parts):
    """The weights with some replaced (their names with __ for dots), or left out by None."""
    weights = WEIGHTS | {key.replace("__", "."): value for key, value in parts.items()}
    return {key: value for key, value in weights.items() if value is not None}


ZEROS = functools.partial(np.zeros, dtype=np.float32)
NOT_FINITE = "'output_block1.fc3.bias' holds values that are not finite numb"


@pytest.mark.parametrize(
    "state, problem",
    [
        ({}, "'output_block1.fc1.weight' is missing"),
        ({"model_state_dict": 3}, "its model_state_dict is not a mapping"),
        (changed(yyy=ZEROS(3), zzz=ZEROS(3)), "'yyy' is unexpected (and 1 more);"),
        (
            changed(input_block__0__weight=ZEROS((64, 9, 7))),
            "'input_block.0.weight' must have shape (64, 6, 7), found (64, 9, 7);",
        ),
        (
            changed(output_block1__fc1__weight=ZEROS((512, 900))),
            "'output_block1.fc1.weight' must have shape (512, 128·⌈N/32⌉) for windows of N samples",
        ),
        (changed(output_block1__fc3__bias=np.array(["a"] * 3)), NOT_FINITE),
    ],
)
def test_weights_that_do_not_fit(state, problem):
    with pytest.raises(InputError, match=f"^state dict: {re.escape(problem)}"):
        interop.load_tlio_state_dict(state)


def test_files_that_are_none(tmp_path):
    (tmp_path / "damaged.npz").write_bytes(b"PK\x03\x04 and no more")
    np.savez(tmp_path / "objects.npz", **{"output_block1.fc1.weight": np.array([{}], object)})
    for name, problem in [
        ("none", "no such file; give"),
        ("damaged", "cannot be read"),
        ("objects", "cannot be read"),
    ]:
        with pytest.raises(InputError, match=f"{name}.npz: {problem}") as refusal:
            interop.load_tlio_state_dict(tmp_path / f"{name}.npz")
        assert "\n" not in str(refusal.value)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "weights.npz"
    np.savez(path, **WEIGHTS)
    return path


def command(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["gnio", "interop", *map(str, arguments)])
    app.main()


def test_a_run_is_made_of_them(file, tmp_path, monkeypatch, capsys, loaded):
    command(monkeypatch, file, tmp_path / "run", "--stride-seconds", "0.1")
    assert f"gnio evaluate --network {tmp_path / 'run'}" in capsys.readouterr().out
    run = read_network(tmp_path / "run")
    assert (run.config.model.name, run.config.dataset) == ("tlio", "tlio")
    of_data = run.config.data
    assert (of_data.rate, of_data.window, of_data.stride) == (200.0, 200, 20)
    assert run.model == models.create("tlio")
    assert make_filter(run.config.data, run.config.filter).config.window_rotation == "tlio"
    assert make_filter(run.config.data, FilterSettings()).config.window_rotation == "per_sample"
    equal(run.variables, loaded)
    for name, options, problem in (
        ("run", (), f"{tmp_path / 'run'}: exists already; name another folder"),
        ("new", ("--rate", "100"), "is for windows of 193 to 224 samples, not 100; give"),
        ("new", ("--stride-seconds", "0.3"), "data.stride_seconds"),
    ):
        with pytest.raises(SystemExit, match="2"):
            command(monkeypatch, file, tmp_path / name, *options)
        message = capsys.readouterr().err
        assert problem in message and message.count("\n") == 1 and not (tmp_path / "new").exists()


def test_a_run_appears_whole_or_not_at_all(file, tmp_path, monkeypatch):
    """The weights fail: no config.yaml without them, and the name is free again."""

    def full(*_):
        raise OSError("No space left on device")

    monkeypatch.setattr(folder, "write_weights", full)
    with pytest.raises(OSError, match="No space"):
        interop.write_run(file, tmp_path / "run", DataConfig())
    assert not list(tmp_path.iterdir())
