"""ONNX models, driven as a program without JAX drives them."""

import dataclasses
import hashlib
import json
import os
import shutil
import subprocess
import sys
import sysconfig
import types
from contextlib import nullcontext
from pathlib import Path

import jax
import numpy as np
import pytest

from gnio_jax import filtering
from gnio_jax.apps.onnx import driver, export_run
from gnio_jax.apps.onnx.networks import deploy_network
from gnio_jax.apps.onnx.programs import Program, programs, start_arrays
from gnio_jax.apps.onnx.run import PACKAGES, Deviation, check, deviation_of
from gnio_jax.commands import app, console
from gnio_jax.config import DataConfig, ModelConfig
from gnio_jax.data.simulated.walks import pedestrian
from gnio_jax.errors import InputError
from gnio_jax.evaluation import Displacements, SequenceEstimate
from gnio_jax.evaluation.trajectory import Trajectory
from gnio_jax.models import Network, registry
from gnio_jax.networks import read_network
from gnio_jax.numerics import matrix_from_quaternion
from tests.apps.onnx.conftest import BIAS, CONFIG, SECONDS
from tests.support import drawn_run
from tests.support.networks import SMALL

EXAMPLE = Path(__file__).parents[3] / "examples" / "onnx"
REST = round(CONFIG.data.rate)
"""Samples."""


@pytest.fixture(scope="module")
def odometry(models, walked):
    """The walk by the models, from a level start."""
    opened = driver.open_models(models[0])
    state = driver.run(opened.start, {"gyro": walked.gyro[:REST], "accel": walked.accel[:REST]})
    return driver.walk(opened, state, walked.gyro, walked.accel)


def from_rest(ekf, walked):
    """The start of `gnio track` and `gnio live`."""
    gyro, accel = walked.gyro[:REST], walked.accel[:REST]
    return filtering.level_state(ekf, gyro, accel)


def test_a_minute_is_that_of_the_package(odometry, models, walked, package):
    def start(ekf):
        return from_rest(ekf, walked)

    history = package(start, walked.gyro, walked.accel)
    first = round(1.0 / CONFIG.data.stride_seconds)
    assert len(odometry.position) == round(SECONDS / CONFIG.data.stride_seconds)
    assert odometry.displacement.shape == (len(odometry.position) - first, 3)
    np.testing.assert_allclose(odometry.displacement, history.displacement[first:], atol=1e-5)
    np.testing.assert_allclose(odometry.position, history.position, atol=1e-3)
    np.testing.assert_allclose(odometry.rotation, history.rotation, atol=1e-5)
    np.testing.assert_allclose(odometry.covariance, history.covariance, rtol=1e-3, atol=1e-4)
    # So does the command say, and refuses what is off.
    folder, printed = models
    measured = json.loads((folder / "export.json").read_text())["accuracy"]
    assert "network.onnx" in printed and "rms" in printed
    assert measured["displacement_largest"] <= 1e-5 and measured["position_largest"] <= 1e-3
    assert measured["ate"] == pytest.approx(measured["ate_of_package"], abs=1e-3)
    with pytest.raises(ValueError, match=r"walk: .* off by 0\.0001 m a window"):
        check(Deviation(1e-4, 1e-4, 10.0, 0.0, 1.0, 1.0), "walk")
    # The walk says something: it moves, and the network turns it from where the IMU alone leads.
    assert (
        np.ptp(odometry.position, axis=0).max() > 1 and np.abs(odometry.displacement).max() > 0.05
    )


@pytest.mark.parametrize(
    "error, std, excess", [(9e-6, 0.1, 0.9), (2e-5, 0.1, 2.0), (2e-5, 1.0, 0.4), (2e-4, 1.0, 4.0)]
)
def test_a_wide_distribution_may_be_rounded_by_more(error, std, excess):
    """A deviation counts against 1e-5 m or a small part of the window's standard deviation."""
    path = Trajectory(np.arange(3.0), np.zeros((3, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)))
    covariance = np.tile(std**2 / 3 * np.eye(3), (3, 1, 1))
    rows = Displacements(np.zeros((3, 3)), covariance)
    package_estimate = SequenceEstimate("walk", path, path, rows)
    displacement, rotation = np.array([[0, 0, 0], [0, error, 0.0]]), np.tile(np.eye(3), (2, 1, 1))
    states = np.zeros((2, 3)), rotation, np.zeros((2, 15, 15))
    exported = driver.WalkResult(np.zeros((2, 9, 6)), displacement, *states)
    deviation = deviation_of(exported, package_estimate)
    assert deviation.displacement_excess == pytest.approx(excess)
    assert deviation.displacement_largest == pytest.approx(error)
    with nullcontext() if excess <= 1 else pytest.raises(InputError, match="the conversion is off"):
        check(deviation, "walk")


def test_the_start_has_the_bias_of_a_gyro_at_rest(run, models, walked):
    """So have the starts of `gnio track` and `gnio live`, which those arrays equal."""
    resting_samples = {"gyro": walked.gyro[:REST], "accel": walked.accel[:REST]}
    arrays = driver.run(driver.open_models(models[0]).start, resting_samples)
    loaded = read_network(run)
    ekf = filtering.make_filter(loaded.config.data, loaded.config.filter)
    network = deploy_network(Network.of(loaded.model, loaded.variables), ekf)
    expected = start_arrays(from_rest(ekf, walked), network, ekf)
    assert arrays.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_allclose(arrays[name], value, atol=1e-9, err_msg=name)
    np.testing.assert_allclose(arrays["state.gyro_bias"], BIAS, atol=1e-9)
    # The clones of a state that a run left are ordered by age: the models would take them for a
    # ring.
    state = from_rest(ekf, walked)
    with pytest.raises(ValueError, match=r"^state: is one after 3 clone intervals of a run"):
        start_arrays(state._replace(step=state.step + 3), network, ekf)


def test_the_filter_is_in_float64_and_every_tensor_is_described(models):
    folder, _ = models
    manifest = json.loads((folder / "export.json").read_text())
    names = {"network.onnx", "filter_start.onnx", "filter_window.onnx", "filter_step.onnx"}
    assert manifest["files"].keys() == names == {path.name for path in folder.glob("*.onnx")}
    for name, described in manifest["files"].items():
        content = (folder / name).read_bytes()
        assert described["bytes"] == len(content)
        assert described["sha256"] == hashlib.sha256(content).hexdigest()
        session = driver.open_session(folder / name)
        for kind, tensors in (("inputs", session.get_inputs()), ("outputs", session.get_outputs())):
            assert [entry["name"] for entry in described[kind]] == [
                tensor.name for tensor in tensors
            ]
            for entry, tensor in zip(described[kind], tensors, strict=True):
                assert entry["shape"] == tensor.shape
                onnx_type = {"float64": "double", "float32": "float"}.get(entry["dtype"])
                assert tensor.type == f"tensor({onnx_type or entry['dtype']})"
                single = {"network.onnx", "filter_window.onnx"}
                if entry["dtype"] == "float32":
                    assert name in single and entry["name"] in ("window", "displacement", "log_std")
    assert manifest["rate"] == CONFIG.data.rate and manifest["filter"]["noise"]["std_factor"][0] > 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["untrained", "--out", "taken"], "taken: exists already"),
        (["untrained"], "untrained: holds no weights"),
        (None, "gnio export: needs the package jax2onnx; pip install 'gnio-jax[onnx]'"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing_behind(
    run, tmp_path, monkeypatch, capsys, arguments, words
):
    for name in PACKAGES:  # as if they were installed, or not: none is needed so early
        module = types.ModuleType(name) if arguments else None
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "thesis.tex").touch()
    (tmp_path / "untrained").mkdir()
    shutil.copy(run / "config.yaml", tmp_path / "untrained")
    with pytest.raises(SystemExit, match="2"):
        console.run(lambda: app.main(["export", *(arguments or ["untrained"])]))
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1
    assert not (tmp_path / "exports").exists()


WINDOWED = {name: (name, SMALL[name]) for name in ("ctin", "experts", "imot", "ionext", "ridi")}
WINDOWED["fourier"] = ("trunk", SMALL["trunk"] | {"block": "fourier"})
WINDOWED |= {
    frame: ("ronin_resnet", {"width": 4, "equivariance": frame})
    for frame in ("o2_frame", "so2_frame", "device_heading")
}
"""Networks with an operation of their own that a conversion has lost, and frames."""


@pytest.mark.slow
@pytest.mark.parametrize("name", WINDOWED)
def test_the_network_alone_gives_the_displacements_of_the_package(converter, name):
    import onnxruntime

    from gnio_jax.apps.onnx import conversion

    network, options = WINDOWED[name]
    model = registry.create(network, **options)
    variables = registry.initialise(model, jax.random.key(0), CONFIG.data.input_samples)
    rotation = "per_sample" if registry.channels(model) == 6 else "body_axes"
    windows = dataclasses.replace(CONFIG.data, window_rotation=rotation)
    ekf = filtering.make_filter(windows, CONFIG.filter)
    deployed = deploy_network(Network.of(model, variables), ekf)
    (program,) = (one for one in programs(deployed, ekf) if one.name == "network")
    session = onnxruntime.InferenceSession(
        conversion.to_model(program, ekf, deployed.first_inferred)
    )
    random = np.random.default_rng(4)
    inputs = {
        key: random.standard_normal(array.shape).astype(array.dtype)
        for key, array in program.inputs.items()
    }
    outputs = session.run(list(program.outputs), inputs)
    expected = program.function({key: jax.numpy.asarray(value) for key, value in inputs.items()})
    for key, value in zip(program.outputs, outputs, strict=True):
        np.testing.assert_allclose(value, expected[key], atol=1e-4, err_msg=key)


def test_an_operation_that_cannot_be_converted_is_named_in_one_line(converter):
    from gnio_jax.apps.onnx import conversion

    def draw(arrays):
        key = jax.random.key(0)
        return {"displacement": arrays["window"] + jax.random.normal(jax.random.split(key)[0])}

    shape = jax.ShapeDtypeStruct((1, 3), np.float32)
    program = Program("network", draw, {"window": shape})
    ekf = filtering.make_filter(CONFIG.data, CONFIG.filter)
    with pytest.raises(InputError, match=r"^network: cannot be converted: .*random.*; write the"):
        conversion.to_model(program, ekf, 0)


@pytest.fixture(
    scope="module",
    params=[
        *(("gru", kind) for kind in ("none", "four_headings", "device_heading")),
        *((network, "none") for network in ("state_space", "ronin_lstm", "ronin_tcn")),
    ],
    ids="-".join,
)
def remembering(request, converter, tmp_path_factory):
    """A network with memory, whose weights are drawn, and the folder of its models."""
    network, equivariance = request.param
    folder = tmp_path_factory.mktemp(network)
    sees_device = equivariance == "device_heading"
    rotation = "body_axes" if sees_device else "per_sample"
    windows = DataConfig(rate=50.0, stride_seconds=0.2, window_rotation=rotation)
    options = {**SMALL[network], "equivariance": equivariance}
    named = {option: options.pop(option) for option in ("width", "equivariance")}
    model = ModelConfig(name=network, **named, options=options)
    config = dataclasses.replace(CONFIG, data=windows, model=model)
    run = drawn_run.save(
        folder / "run", config, lambda random, _, shape: random.normal(0, 0.3, shape)
    )
    export_run(run, folder / "models", seconds=2.0)
    return run, folder / "models"


def test_a_network_with_memory_is_that_of_the_package(remembering):
    """The filter corrects the yaw, so the frame of the memory turns on the way."""
    run, folder = remembering
    loaded = read_network(run)
    ekf = filtering.make_filter(loaded.config.data, loaded.config.filter)
    network = Network.of(loaded.model, loaded.variables)
    walk = pedestrian(5, 5, seconds=12.0, rate=loaded.config.data.rate)
    count = 10 * (len(walk.gyro) // 10)
    gyro, accel = walk.gyro[:count] + BIAS, walk.accel[:count]
    start = filtering.initial_state(
        ekf, matrix_from_quaternion(walk.orientation[0]), np.ones(3), np.zeros(3)
    )
    predict = network.predict(lambda prediction: prediction._replace(diagnostics={}))
    history = jax.jit(lambda start: filtering.run_odometry(predict, ekf, start, gyro, accel)[1])(
        start
    )
    arrays = start_arrays(start, deploy_network(network, ekf), ekf)
    walked = driver.walk(driver.open_models(folder), arrays, gyro, accel)
    assert np.nansum(history.accepted) > 20
    first = ekf.config.first_measured
    assert len(walked.windows) == len(walked.position) == len(walked.displacement) + first
    np.testing.assert_allclose(walked.displacement, history.displacement[first:], atol=1e-5)
    np.testing.assert_allclose(walked.position, history.position, atol=1e-4)
    np.testing.assert_allclose(walked.rotation, history.rotation, atol=1e-6)
    np.testing.assert_allclose(walked.covariance, history.covariance, rtol=1e-4, atol=1e-6)
    # An integration without updates ends elsewhere.
    alone = filtering.run_filter(
        ekf,
        start,
        gyro,
        accel,
        np.full((len(history.position), 3), np.nan),
        np.tile(np.eye(3), (len(history.position), 1, 1)),
    )[1]
    turned = alone.rotation[-1] @ np.asarray(history.rotation[-1]).T
    assert np.abs(np.arctan2(turned[1, 0], turned[0, 0])) > 1e-3


def test_the_state_of_a_memory_is_given_back_by_the_network(remembering):
    _, folder = remembering
    manifest = json.loads((folder / "export.json").read_text())["files"]
    names = {
        (name, kind): {tensor["name"] for tensor in described[kind]}
        for name, described in manifest.items()
        for kind in ("inputs", "outputs")
    }
    inputs, outputs = names["network.onnx", "inputs"], names["network.onnx", "outputs"]
    state = {name for name in inputs if name.startswith("state.memory.network")}
    assert state == inputs - {"window"} and state < names["filter_start.onnx", "outputs"]
    assert {name.replace("state.", "next.", 1) for name in state} < outputs
    assert not state & names["filter_step.onnx", "inputs"]


def library(folder):
    """ONNX Runtime for C++: headers of the system or of $ONNXRUNTIME_INCLUDE, and the library, of
    the system or of the Python package."""
    places = [os.environ.get("ONNXRUNTIME_INCLUDE"), "/usr/include/onnxruntime", "/usr/include"]
    headers = [path for path in filter(None, places) if Path(path).is_dir()]
    headers = [path for path in headers if (Path(path) / "onnxruntime_cxx_api.h").is_file()]
    if not headers or not shutil.which("cmake") or not shutil.which("c++"):
        pytest.skip("needs cmake, a compiler and ONNX Runtime's C++ headers ($ONNXRUNTIME_INCLUDE)")
    capi = Path(sysconfig.get_paths()["purelib"]) / "onnxruntime" / "capi"
    libraries = sorted(capi.glob("libonnxruntime.so.*"))
    if not libraries:
        return headers[0], "/usr/lib/libonnxruntime.so"
    for name in ("libonnxruntime.so", "libonnxruntime.so.1"):
        (folder / name).symlink_to(libraries[0])
    return headers[0], folder / "libonnxruntime.so"


STUB = r"""
#pragma once
#include <cstdint>
#include <memory>
#include <string>
#include <vector>
enum { ORT_LOGGING_LEVEL_ERROR };
namespace Ort {
struct AllocatorWithDefaultOptions { int GetInfo() const { return 0; } };
struct Value {
  std::vector<double> doubles;
  std::vector<float> floats;
  template <class T>
  static Value CreateTensor(AllocatorWithDefaultOptions&, const int64_t*, size_t) {
    return Value{std::vector<double>(9), {}};
  }
  template <class T> T* GetTensorMutableData() { return doubles.data(); }
  template <class T> const T* GetTensorData() const {
    if constexpr (sizeof(T) == 4) return floats.data();
    else return doubles.data();
  }
};
using Text = std::unique_ptr<char[]>;
struct Shape { std::vector<int64_t> GetShape() { return {0}; } };
struct Type { Shape GetTensorTypeAndShapeInfo() { return {}; } };
struct Metadata {
  Text LookupCustomMetadataMapAllocated(const char*, AllocatorWithDefaultOptions&) { return {}; }
};
struct Env { Env(int, const char*) {} };
struct SessionOptions { void SetIntraOpNumThreads(int) {} };
struct RunOptions {};
struct IoBinding;
struct Session {
  Session(Env&, const char*, const SessionOptions&) {}
  size_t GetInputCount() { return 0; }
  size_t GetOutputCount() { return 0; }
  Text GetInputNameAllocated(size_t, AllocatorWithDefaultOptions&) { return {}; }
  Text GetOutputNameAllocated(size_t, AllocatorWithDefaultOptions&) { return {}; }
  Type GetInputTypeInfo(size_t) { return {}; }
  Metadata GetModelMetadata() { return {}; }
  void Run(const RunOptions&, IoBinding&) {}
};
struct IoBinding {
  IoBinding(Session&) {}
  void BindInput(const char*, const Value&) {}
  void BindOutput(const char*, int) {}
  std::vector<std::string> GetOutputNames() { return {}; }
  std::vector<Value> GetOutputValues() { return {}; }
};
}  // namespace Ort
"""
"""The parts of ONNX Runtime that the example uses, which do nothing."""
CALL = r"""
#define main unused
#include "track.cpp"
#undef main
int main(int count, char** arguments) {
  if (count > 2) try {
    std::cout << read(arguments[2]).size();
    return 0;
  } catch (const std::exception& error) {
    std::cout << error.what();
    return 2;
  }
  Tensors answer;
  answer.emplace("displacement", Ort::Value{{}, {1.0f, 2.0f, 3.0f}});
  answer.emplace("log_std", Ort::Value{{}, {-1.0f, -9.0f, -2.0f}});
  if (count > 1) answer.emplace("axes", Ort::Value{{}, {0.6f, 0.8f}});
  const Tensors given = measured(&answer, -3.0);
  for (int i = 0; i < 9; ++i) std::cout << given.at("covariance").doubles[i] << " ";
}
"""


@pytest.fixture(scope="module")
def call(tmp_path_factory):
    """A program that calls functions of the example in C++."""
    if not shutil.which("c++"):
        pytest.skip("needs a compiler")
    folder = tmp_path_factory.mktemp("call")
    (folder / "onnxruntime_cxx_api.h").write_text(STUB)
    (folder / "call.cpp").write_text(CALL)
    command = ["c++", "-std=c++17", "-w", f"-I{folder}", f"-I{EXAMPLE}", folder / "call.cpp"]
    subprocess.run([*command, "-o", folder / "call"], check=True)
    return lambda *words: subprocess.run([folder / "call", *words], capture_output=True, text=True)


@pytest.mark.parametrize(
    ("rows", "printed"),
    [
        ("0,0,0,0,0,0,9.8\r\n0.02,0,0,0,0,0,9.8\r\n\r\n", "2"),
        ("", "{}: has fewer than two samples"),
        ("0,0,0,0,0,0,9.8\n0.02,0,0,,0,0,9.8\n", "{} row 2: seven finite numbers are expected"),
        ("0,0,0,0,0,0,9.8\n0.02,0,0,0,0,0\n", "{} row 2: seven finite numbers are expected"),
        ("0,0,0,0,0,0,9.8\n0,0,0,0,0,0,9.8\n", "{} row 2: seven finite numbers are expected"),
    ],
    ids=["an empty line", "no sample", "no value", "a short row", "a stamp twice"],
)
def test_the_example_in_c_names_what_it_cannot_read(call, tmp_path, rows, printed):
    path = tmp_path / "walk.csv"
    path.write_bytes(f"time,gx,gy,gz,ax,ay,az\n{rows}".encode())
    done = call("read", path)
    assert done.stdout.startswith(printed.format(path))
    assert done.returncode == (0 if printed == "2" else 2)


def test_the_example_in_c_turns_the_variances_of_a_frame(call):
    """As `export.json` says: a network with a frame of its own has them along its axes."""
    variances = np.diag(np.exp([-2.0, -6.0, -4.0]))  # that of y is raised to the least
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    for words, expected in (([], variances), (["axes"], turn @ variances @ turn.T)):
        values = np.reshape([float(word) for word in call(*words).stdout.split()], (3, 3))
        np.testing.assert_allclose(values, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_the_example_in_c(models, walked, odometry, tmp_path):
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
    np.testing.assert_allclose(tracked[:, 1:4], odometry.position, atol=1e-6)
    np.testing.assert_allclose(tracked[:, 0], CONFIG.data.stride_seconds * np.arange(1, 241))
    variances = np.diagonal(odometry.covariance, axis1=1, axis2=2)[:, 6:9]
    np.testing.assert_allclose(tracked[:, 4:], np.sqrt(variances), rtol=1e-6)
    wrong = subprocess.run([build / "track", tmp_path, csv, out], capture_output=True, text=True)
    assert wrong.returncode == 2 and "network.onnx" in wrong.stderr
