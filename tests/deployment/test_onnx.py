"""ONNX models, driven as a program without JAX drives them."""

import hashlib
import json
import os
import shutil
import subprocess
import sysconfig
from pathlib import Path

import numpy as np
import pytest

from gnio_jax import filtering
from gnio_jax.deployment import accuracy, conversion, driver
from gnio_jax.deployment.precision import in_precision
from tests.deployment.conftest import CONFIG, SECONDS, call

onnx = pytest.importorskip("onnx", reason="needs pip install 'gnio-jax[onnx]'")

EXAMPLE = Path(__file__).parents[2] / "examples" / "onnx"
REST = round(CONFIG.data.rate)
"""Samples."""


@pytest.fixture(scope="module")
def found(models, walked):
    """The walk by the models, from a level start."""
    opened = driver.open_models(models[0])
    state = driver.run(opened.start, {"gyro": walked.gyro[:REST], "accel": walked.accel[:REST]})
    return driver.walk(opened, state, walked.gyro, walked.accel)


def test_a_minute_is_that_of_the_package(found, walked, package):
    def start(setup):
        rest = walked.gyro[:REST], walked.accel[:REST]
        return filtering.level_state(setup.config, *rest, setup.initial_std)

    history = package(start, walked.gyro, walked.accel)
    first = round(1.0 / CONFIG.data.stride_seconds)
    assert len(found.position) == round(SECONDS / CONFIG.data.stride_seconds)
    assert found.displacement.shape == (len(found.position) - first, 3)
    np.testing.assert_allclose(found.displacement, history.displacement[first:], atol=1e-5)
    np.testing.assert_allclose(found.position, history.position, atol=1e-3)
    np.testing.assert_allclose(found.rotation, history.rotation, atol=1e-5)
    np.testing.assert_allclose(found.covariance, history.covariance, rtol=1e-3, atol=1e-4)
    # The walk says something: it moves, and the network turns it from where the IMU alone leads.
    assert np.ptp(found.position, axis=0).max() > 1 and np.abs(found.displacement).max() > 0.05


def test_the_filter_is_in_float64_and_every_tensor_is_described(models):
    folder, _ = models
    manifest = json.loads((folder / "export.json").read_text())
    names = {"network.onnx", "filter_start.onnx", "filter_window.onnx", "filter_step.onnx"}
    assert manifest["files"].keys() == names == {path.name for path in folder.glob("*.onnx")}
    for name, said in manifest["files"].items():
        content = (folder / name).read_bytes()
        assert said["sha256"] == hashlib.sha256(content).hexdigest()
        assert said["bytes"] == len(content)
        session = driver.open_session(folder / name)
        for kind, tensors in (("inputs", session.get_inputs()), ("outputs", session.get_outputs())):
            assert [each["name"] for each in said[kind]] == [each.name for each in tensors]
            for each, tensor in zip(said[kind], tensors, strict=True):
                assert each["shape"] == tensor.shape and each["meaning"]
                onnx_type = {"float64": "double", "float32": "float"}.get(each["dtype"])
                assert tensor.type == f"tensor({onnx_type or each['dtype']})"
                single = {"network.onnx", "filter_window.onnx"}
                if each["dtype"] == "float32":
                    assert name in single and each["name"] in ("window", "displacement", "log_std")
    assert manifest["rate"] == CONFIG.data.rate and manifest["filter"]["noise"]["std_factor"][0] > 1


def test_the_command_says_how_far_it_is_from_the_package(models):
    folder, told = models
    measured = json.loads((folder / "export.json").read_text())["accuracy"]
    assert "network.onnx" in told and "rms" in told
    assert measured["displacement_largest"] <= 1e-5 and measured["position_largest"] <= 1e-3
    assert measured["ate"] == pytest.approx(measured["ate_of_package"], abs=1e-3)


def test_a_network_in_int8(run, models, found, tmp_path, monkeypatch):
    """The other models are those of the first export, which need not be converted again."""
    before, _ = models
    monkeypatch.setattr(
        conversion, "to_model", lambda program, _: conversion.read(before / f"{program.name}.onnx")
    )
    told = call("export", run, "--to", "onnx", "--precision", "int8", "--out", tmp_path / "int8")
    manifest = json.loads((tmp_path / "int8" / "export.json").read_text())
    measured = manifest["accuracy"]
    assert manifest["precision"] == "int8" and f"rms {measured['displacement_rms']:.2g} m" in told
    assert 1e-4 < measured["displacement_rms"] < 0.2 and measured["position_largest"] > 1e-4
    check_bits(tmp_path / "int8" / "network.onnx", found, onnx.TensorProto.INT8, 0.2)
    for name in ("filter_step.onnx", "filter_window.onnx"):
        assert (tmp_path / "int8" / name).read_bytes() == (before / name).read_bytes()


def test_a_network_in_float16(models, found, tmp_path):
    path = tmp_path / "network.onnx"
    network = conversion.read(models[0] / "network.onnx")
    conversion.write(in_precision(network, "float16", found.windows), path)
    check_bits(path, found, onnx.TensorProto.FLOAT16, 0.01)


def check_bits(path, found, bits, worst):
    """Kernels are of the type `bits`, inputs and outputs are float32, and displacements change, by
    `worst` at most."""
    kernels = [each for each in onnx.load(path).graph.initializer if len(each.dims) == 3]
    assert sum(each.data_type == bits for each in kernels) >= 20  # the convolutions of a ResNet-18
    session = driver.open_session(path)
    ends = (*session.get_inputs(), *session.get_outputs())
    assert {each.type for each in ends} == {"tensor(float)"}
    said = accuracy.of_windows(session, found.windows)
    rms = np.sqrt(np.mean(np.sum((said - found.displacement) ** 2, axis=1)))
    assert 1e-6 < rms < worst


def test_a_conversion_that_is_off_is_refused():
    off = accuracy.Deviation(1e-4, 1e-4, 0.0, 1.0, 1.0)
    with pytest.raises(ValueError, match=r"--to onnx: .* off by 0\.0001 m a window"):
        accuracy.check(off, "--to onnx", "jax2onnx")


def library(folder):
    """ONNX Runtime for C++: headers of the system or of $ONNXRUNTIME_INCLUDE, and the library, of
    the system or of the Python package."""
    places = [os.environ.get("ONNXRUNTIME_INCLUDE"), "/usr/include/onnxruntime", "/usr/include"]
    headers = [place for place in filter(None, places) if Path(place).is_dir()]
    headers = [place for place in headers if (Path(place) / "onnxruntime_cxx_api.h").is_file()]
    if not headers or not shutil.which("cmake") or not shutil.which("c++"):
        pytest.skip("needs cmake, a compiler and ONNX Runtime's C++ headers ($ONNXRUNTIME_INCLUDE)")
    capi = Path(sysconfig.get_paths()["purelib"]) / "onnxruntime" / "capi"
    found = sorted(capi.glob("libonnxruntime.so.*"))
    if not found:
        return headers[0], "/usr/lib/libonnxruntime.so"
    for name in ("libonnxruntime.so", "libonnxruntime.so.1"):
        (folder / name).symlink_to(found[0])
    return headers[0], folder / "libonnxruntime.so"


def test_the_example_in_c(models, walked, found, tmp_path):
    headers, shared = library(tmp_path)
    build, csv, out = tmp_path / "build", tmp_path / "walk.csv", tmp_path / "positions.csv"
    definitions = [f"-DONNXRUNTIME_INCLUDE={headers}", f"-DONNXRUNTIME_LIBRARY={shared}"]
    debug = "-DCMAKE_BUILD_TYPE=Debug"  # compiles in half the time
    for command in (["-S", EXAMPLE, "-B", build, debug, *definitions], ["--build", build]):
        subprocess.run(["cmake", *command], check=True, capture_output=True)
    time = np.arange(len(walked.gyro)) / CONFIG.data.rate
    table = np.column_stack([time, walked.gyro, walked.accel])
    np.savetxt(csv, table, delimiter=",", header="time,gx,gy,gz,ax,ay,az", comments="", fmt="%.17g")
    subprocess.run([build / "track", models[0], csv, out], check=True)
    tracked = np.loadtxt(out, delimiter=",", skiprows=1)
    np.testing.assert_allclose(tracked[:, 1:4], found.position, atol=1e-6)
    np.testing.assert_allclose(tracked[:, 0], CONFIG.data.stride_seconds * np.arange(1, 241))
    variances = np.diagonal(found.covariance, axis1=1, axis2=2)[:, 6:9]
    np.testing.assert_allclose(tracked[:, 4:], np.sqrt(variances), rtol=1e-6)
    wrong = subprocess.run([build / "track", tmp_path, csv, out], capture_output=True, text=True)
    assert wrong.returncode == 2 and "network.onnx" in wrong.stderr
