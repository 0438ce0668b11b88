"""The whole odometry as one program."""

import json
import shutil
import subprocess
import sys
import types

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import deployment, filtering
from gnio_jax.commands import app, console
from gnio_jax.errors import InputError

ALONE = """
import sys
import jax, jax.export, numpy as np
jax.config.update("jax_enable_x64", True)
program = jax.export.deserialize(bytearray(open(sys.argv[1], "rb").read()))
arrays = dict(np.load(sys.argv[2]))
found = jax.jit(program.call)(arrays)
assert not [name for name in sys.modules if name.split(".")[0] in ("gnio_jax", "flax")]
np.savez(sys.argv[3], **found)
"""


@pytest.fixture(scope="module")
def program(run):
    """Exported in a process of its own: the tests' run-time checker knows no symbolic shapes."""
    pytest.importorskip("flatbuffers", reason="needs pip install 'gnio-jax[stablehlo]'")
    out = run.parent / "program"
    command = ["-m", "gnio_jax", "export", run, "--to", "stablehlo", "--out", out]
    said = subprocess.run([sys.executable, *command], check=True, stdout=subprocess.PIPE, text=True)
    return out, said.stdout


def test_a_fresh_process_without_the_package(program, walked, package, tmp_path):
    folder, told = program
    signals = {"gyro": walked.gyro, "accel": walked.accel}
    start = {
        "rotation": Rotation.from_euler("zyx", [1.0, 0.1, -0.2]).as_matrix(),
        "velocity": np.array([0.3, 0.1, 0.0]),
        "position": np.array([5.0, -2.0, 1.0]),
        "gyro_bias": np.array([0.001, 0.0, -0.002]),
    }

    def state(setup):
        return filtering.initial_state(setup.config, **start, std=setup.initial_std)

    wanted = np.asarray(package(state, *signals.values()).position)
    manifest = json.loads((folder / "export.json").read_text())
    whole = 40 * manifest["samples_per_round"]
    np.savez(tmp_path / "in.npz", **start, **{key: x[:whole] for key, x in signals.items()})
    files = [folder / "odometry.stablehlo", tmp_path / "in.npz", tmp_path / "out.npz"]
    subprocess.run([sys.executable, "-c", ALONE, *files], check=True)
    alone = np.load(tmp_path / "out.npz")["position"]
    assert len(alone) == whole // manifest["samples_per_clone"]
    np.testing.assert_allclose(alone, wanted[: len(alone)], atol=1e-9)

    # The loader takes any number of clone intervals, and leaves what is no whole one.
    cut = {key: x[: whole + 14] for key, x in signals.items()}
    found = deployment.load_odometry(folder)({**start, **cut})["position"]
    assert len(found) == len(alone) + 14 // manifest["samples_per_clone"]
    np.testing.assert_allclose(found, wanted[: len(found)], atol=1e-9)
    assert "odometry.stablehlo" in told and manifest["accuracy"]["position_largest"] <= 1e-9


def test_a_damaged_program_is_refused(program, tmp_path, monkeypatch):
    shutil.copytree(program[0], tmp_path / "copy")
    path = tmp_path / "copy" / "odometry.stablehlo"
    path.write_bytes(path.read_bytes()[:-1] + b"?")
    with pytest.raises(InputError, match="SHA-256 differs"):
        deployment.load_odometry(path.parent)
    path.unlink()
    with pytest.raises(InputError, match="cannot be read"):
        deployment.load_odometry(path.parent)
    (path.parent / "export.json").write_text('{"format": "gnio-export", "version": 99}')
    with pytest.raises(InputError, match="version 99"):
        deployment.load_odometry(path.parent)
    monkeypatch.setitem(sys.modules, "flatbuffers", None)
    with pytest.raises(InputError, match=r"flatbuffers; pip install 'gnio-jax\[stablehlo\]'"):
        deployment.load_odometry(path.parent)


@pytest.mark.parametrize(
    "arguments, told",
    [
        (["--to", "onnx", "--precision", "int4"], "--precision: must be one of float32, float16"),
        (["--to", "torch"], "--to: must be one of onnx, stablehlo"),
        (["--to", "stablehlo", "--precision", "int8"], "--precision: 'int8' is for --to onnx"),
        (["--to", "stablehlo", "--out", "taken"], "taken: is there already"),
        (["--to", "stablehlo"], "untrained/checkpoints/best: holds no checkpoint"),
        (["--to", "onnx"], "--to onnx: needs the package jax2onnx; pip install 'gnio-jax[onnx]'"),
    ],
)
def test_mistakes(run, tmp_path, monkeypatch, capsys, arguments, told):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "jax2onnx", None)  # as if it were not installed
    monkeypatch.setitem(
        sys.modules, "flatbuffers", types.ModuleType("flatbuffers")
    )  # as if it were
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "thesis.tex").touch()
    (tmp_path / "untrained").mkdir()
    shutil.copy(run / "config.yaml", tmp_path / "untrained")
    with pytest.raises(SystemExit, match="2"):
        console.run(lambda: app.main(["export", "untrained", *arguments]))
    error = capsys.readouterr().err
    assert told in error and error.count("\n") == 1
    assert not (tmp_path / "exports").exists()
