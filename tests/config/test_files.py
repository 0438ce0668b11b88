"""Strict YAML, checks and settings of the command line."""

import dataclasses
import os
import threading
from pathlib import Path

import numpy as np
import pytest

from gnio_jax import config as configuration
from gnio_jax.commands import options, train
from gnio_jax.commands.options import Call
from gnio_jax.config import (
    CorrelatedError,
    FilterSettings,
    NoiseModel,
    ThroughFilter,
    TrainConfig,
)
from gnio_jax.errors import InputError
from tests.support.filter_settings import changed


def read(text):
    return configuration.validate(configuration.parse(text, "f.yaml"), "f.yaml")


def refused(text):
    with pytest.raises(InputError) as mistake:
        read(text)
    assert "\n" not in str(mistake.value) and len(str(mistake.value)) < 400
    return mistake.value.parts


@pytest.mark.parametrize(
    "text",
    [
        "seed: 1\nseed: 2",
        "optim: {epochs: 3, epochs: 4}",
        "seed: !!timestamp 2020-13-45",
        "seed: !!int 0b_",
        "seed: !!map [1, 2]",
        "data: {rate: !!float ''}",
        "augment: {yaw: !!bool maybe}",
        "seed: " + "9" * 5000,
        "seed: " + "[" * 3000,
        "seed: [&a [x], *a]",
        "? [a]\n: 3",
        "a: [",
        "!!python/object/apply:os.system ['true']",
    ],
)
def test_what_is_no_yaml_is_one_line_that_names_the_file(text):
    source, problem, _ = refused(text)
    assert source == "f.yaml" and problem.startswith("is not YAML (")


@pytest.mark.parametrize(
    ("field", "texts"),
    {
        "<<": ["<<: {seed: 3}"],
        "dataset": ["dataset: [tlio, tlio]", "dataset: []"],
        "data_root": ["dataset: [a, b]\ndata_root: here"],
        "data.weights": [
            *("dataset: [a, b]\ndata: {weights: [1]}", "dataset: [a, b]\ndata: {weights: [1, 0]}"),
        ],
        "model.equivariance": [
            "model: {equivariance: so3}",
            "model: {equivariance: four_headings}\naugment: {yaw: false}",
            "model: {equivariance: device_heading}\naugment: {yaw: false}",
        ],
        "augment.hidden_axes_share": [
            *("augment: {hidden_axes_share: 0.3}", "augment: {hidden_axes_share: 2.0}"),
        ],
        "model.output_dim": ["model: {output_dim: 4}", "model: {output_dim: 2.0}"],
        "seed": [
            *("seed: 010", "seed: 1:30", "seed: 0b_", "seed: 0x1f", "seed: 2020-13-45"),
            *("seed: " + "9" * 400, "seed: 99999999999999999999999", "seed: -1", "seed: 1e0"),
        ],
        "through_filter.learn": ["through_filter: {learn: noise}"],
        "through_filter.piece_seconds": [
            "through_filter: {piece_seconds: !!float .inf}",
            "data: {window_seconds: 0.5}\nthrough_filter: {learn: [noise], piece_seconds: 0.7}",
        ],
        "augment.yaw": ["augment: {yaw: 1}", "augment: {yaw: yes}"],
        "augment.low_pass_hertz": ["augment: {low_pass_hertz: [25, 4]}"],
        "data.rate": [
            *("data: {rate: .inf}", "data: {rate: 1e999}", "data: {rate: " + "9" * 400 + "}"),
        ],
        "data.window_seconds": ["data: {rate: 1e308, window_seconds: 1e308}"],
        "data.train_stride_seconds": ["data: {train_stride_seconds: 1e-9}"],
        "loss.mse_weight": ["loss: {mse_weight: !!float .nan}", "loss: {mse_weight: -5}"],
        "optim.epochs": ["optim: {epochs: '3'}", "optim: {epochs: 99999999999}"],
        "filter.measurement_scale": ["filter: {measurement_scale: 1}"],
        "filter.noise.gyro_densty": ["filter: {noise: {gyro_densty: 1}}"],
        "filter.noise.measurement_scale": ["filter: {noise: {measurement_scale: 0}}"],
        "filter.noise.std_factor": ["filter: {noise: {std_factor: [1, 2]}}"],
        "filter.noise.correlation.share": ["filter: {noise: {correlation: {share: 1}}}"],
    }.items(),
)
def test_a_mistake_is_one_line_that_names_the_file_and_the_field(field, texts):
    for text in texts:
        source, problem, _ = refused(text)
        assert source == "f.yaml" and f"field '{field}' " in f"{problem} ", text


ALIASES = [f"&a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 10)]
"""Lists that have the one before ten times: printed, the last one has 10^9 entries."""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("# only a comment", "is empty"),
        ("- 1", "[1]"),
        (f"seed: [&a0 [x], {', '.join(ALIASES)}]", "aliases are not for settings"),
        ("filter: {noise: {gyro_densty: 1}}", "'filter.noise.gyro_density'"),
        ("model: {head: gatde}", "'gated'"),
        ('workdir: "a\\0b"', "field 'workdir' holds a zero, which no name of a file has"),
        ("data: {context_seconds: 59.5}", "'data.context_seconds' makes an input of more than 60"),
        ("model: {width: 4097}", "field 'model.width' must be from 1 to 4096"),
    ],
)
def test_a_mistake_is_named_with_a_remedy(text, words):
    source, problem, remedy = refused(text)
    assert source == "f.yaml" and words in f"{problem}; {remedy}"


def test_numbers_are_those_of_yaml_1_2():
    config = read("optim: {learning_rate: 1e-3}\nloss: {mse_weight: 3}\ndata: {rate: 2.e+2}")
    assert (config.optim.learning_rate, config.loss.mse_weight, config.data.rate) == (
        1e-3,
        3.0,
        200.0,
    )


def test_text_that_looks_like_something_else_survives_its_file():
    for name in ("1e-3", "010", "yes", "null", "2020-01-01", "~", "a: b", "1:30"):
        config = TrainConfig(workdir=name, filter=changed(noise={"correlation": CorrelatedError()}))
        assert read(configuration.to_yaml(config)) == config


def experiment_of(*words):
    call = Call("gnio train", words)
    return train.experiment(options.read(train.train, call), call)


def test_a_pipe_is_read_once(tmp_path):
    """Also by the command, whose words are read twice."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for read in (lambda: configuration.load(pipe), lambda: experiment_of("--config", str(pipe))):
        writer = threading.Thread(target=pipe.write_text, args=("seed: 7",))
        writer.start()
        assert read().seed == 7
        writer.join()


def test_the_folder_of_a_run_stands_for_its_config(tmp_path):
    configuration.save(tmp_path / "config.yaml", TrainConfig(seed=5))
    assert configuration.load(tmp_path).seed == 5
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"empty: cannot be read .*Is a directory"):
        configuration.load(tmp_path / "empty")


def test_settings_are_assigned_by_name():
    config = configuration.assign(
        TrainConfig(),
        [
            "filter.noise.gyro_density=1e-3",
            "filter.noise.correlation.share=0.9",
            "filter.noise.std_factor=[1, 2, 0.5]",
            "optim.epochs=3",
            "optim.epochs=4",
            "through_filter.learn=[noise]",
            "workdir=runs/a=b",
        ],
    )
    noise = NoiseModel(
        1e-3, std_factor=(1.0, 2.0, 0.5), correlation=CorrelatedError(share=0.9, seconds=0.5)
    )
    assert config == dataclasses.replace(
        TrainConfig(),
        workdir="runs/a=b",
        filter=FilterSettings(noise),
        optim=dataclasses.replace(TrainConfig().optim, epochs=4),
        through_filter=ThroughFilter(learn=("noise",)),
    )
    off = configuration.assign(config, ["filter.noise.correlation=null"])
    assert off.filter.noise == noise._replace(correlation=None)


def test_an_assignment_that_makes_no_sense_is_named():
    for assignment, problem in (
        ("optim.epochs", "is not a setting; write section.field=value"),
        ("=3", "is not a setting"),
        ("optim.epohcs=3", "unknown field 'optim.epohcs'; did you mean 'optim.epochs'?"),
        ("optim=3", "optim must be a mapping of fields, found 3"),
        ("optim.epochs.x=3", "field 'optim.epochs' must be a whole number"),
        ("optim.epochs=3.5", "field 'optim.epochs' must be a whole number, found 3.5"),
        ("seed=[", "is not YAML"),
    ):
        with pytest.raises(InputError) as refused:
            configuration.assign(TrainConfig(), [assignment])
        assert assignment in str(refused.value) and problem in str(refused.value)


def test_words_of_a_command_line_are_values():
    for hint, words, value in (
        (int, ["3"], 3),
        (float, ["1e-3"], 1e-3),
        (float | None, ["null"], None),
        (str | None, ["010"], "010"),
        (str | None, ["null"], None),
        (tuple[int, ...], ["1", "2"], (1, 2)),
        (tuple[str, ...], ["1", "true"], ("1", "true")),
        (tuple[int, ...], [], ()),
        (bool, ["false"], False),
        (str | tuple[str, ...], ["one"], "one"),
        (str | tuple[str, ...], ["one", "two"], ("one", "two")),
        (Path, ["010"], Path("010")),
    ):
        parsed_value = configuration.parse_words(hint, words, "--x")
        assert parsed_value == value and type(parsed_value) is type(value)
    for hint, words, problem in (
        (int, ["3.5"], "--x: must be a whole number, found 3.5"),
        (str | tuple[int, ...], ["1", "x"], "--x: must be a whole number, found 'x'"),
        (int, ["0x10"], "--x: must be a whole number, found '0x10'"),
        (float, [".inf"], "--x: must be a number, found '.inf'"),
        (tuple[int, ...], ["1", "a"], "--x: must be a whole number, found 'a'"),
    ):
        with pytest.raises(InputError) as refused:
            configuration.parse_words(hint, words, "--x")
        assert str(refused.value) == problem


def test_settings_of_a_program_may_be_numbers_of_numpy():
    config = TrainConfig(filter=changed(noise={"gyro_density": np.float32(1e-3)}))
    assert configuration.validate(config) is config
    with pytest.raises(InputError, match=r"config: field 'filter\.noise\.gyro_density'"):
        configuration.validate(TrainConfig(filter=changed(noise={"gyro_density": np.float32(0)})))
