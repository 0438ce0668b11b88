"""What the tables vary, and what they do not."""

import dataclasses
import typing

import pytest

from gnio_jax import config as configuration
from gnio_jax import models
from gnio_jax.config import LossConfig, SegmentTraining, TablesConfig
from gnio_jax.errors import InputError
from gnio_jax.models.trunk import Trunk
from gnio_jax.tables import experiments, make
from tests.support.reports import BASE


def test_rows_differ_in_the_network_alone():
    """Every row can be built, two are never the same, those of a name are, in every table; loss and
    regularisation apart, only the network differs. Every checkpoint is chosen by one criterion."""
    chosen = dataclasses.replace(BASE.optim, best_by="squared_error")
    same = dataclasses.replace(BASE, optim=chosen)
    makers = [experiments.components, experiments.gates, experiments.bank_sizes]
    tables = [make(BASE) for make in makers] + [experiments.comparison(BASE, "tlio", "test")]
    rows, configs = [row for table in tables for row in table.rows], {}
    for row in rows:
        config = row.config
        assert models.from_config(config.model) is not None
        assert configs.setdefault(row.name, config) == config
        decay = {name: getattr(chosen, name) for name in ("clip_norm", "weight_decay")}
        optim = dataclasses.replace(config.optim, **decay)
        assert dataclasses.replace(config, model=BASE.model, loss=BASE.loss, optim=optim) == same
        if config.model.name == "gnio":
            assert (config.loss, config.optim) == (same.loss, same.optim)
    assert len(set(map(str, configs.values()))) == len(configs) < len(rows)


@pytest.mark.parametrize(
    "epochs, batch, held", [(200, 128, 9), (24, 1024, 9), (24, 128, 1.125), (8, 1024, 4)]
)
def test_tlio_is_held_for_the_published_steps_or_half_of_the_run(epochs, batch, held):
    optim = dataclasses.replace(BASE.optim, epochs=epochs, batch_size=batch)
    base = dataclasses.replace(BASE, optim=optim)
    assert experiments.method("tlio", base).loss.log_std_from_epoch == held


def test_rows_are_the_published_configurations():
    gates = {row.label: row.config.model for row in experiments.gates(BASE).rows}
    assert all(model.bank_size == 0 for model in gates.values())
    assert gates["tanh × exp"].scale == "exp"
    banks = [models.from_config(row.config.model) for row in experiments.bank_sizes(BASE).rows]
    assert all(bank.head == "linear" for bank in banks)
    assert [bank.bank_size for bank in banks] == [0, 16, 32, 64, 128]
    parts = [(row.config.model.name, row.published) for row in experiments.components(BASE).rows]
    assert parts == [("tlio", 2.40), ("gnio", None), ("gnio", 1.98), ("gnio", 1.84), ("gnio", 1.66)]


@pytest.mark.parametrize("network", [*(x for x in experiments.METHODS if x != "gnio"), "imot_text"])
def test_losses_and_regularisation_are_those_of_the_published_recipes(network):
    row = experiments.method(network, BASE)
    recipe = configuration.validate(configuration.load(f"configs/baselines/{network}.yaml"))
    assert recipe.model.name == network
    optim, loss = dataclasses.replace(BASE.optim, epochs=200), LossConfig(outlier_sigmas=10.0)
    published = dataclasses.replace(BASE, optim=optim, loss=loss)
    assert experiments.loss(network, published) == recipe.loss
    for name in ("clip_norm", "weight_decay"):
        assert getattr(row.optim, name) == getattr(recipe.optim, name)
    assert models.from_config(recipe.model) is not None


@pytest.mark.parametrize(
    "width, widths", [(16, (16, 24, 24, 8)), (4, (4, 8, 6, 2)), (None, (None, None, None, None))]
)
def test_networks_on_windows_have_one_share_of_their_published_widths(width, widths):
    """Those with memory are small as published. CTIN's width is a multiple of its 8 heads, and
    iMoT, whose features are the samples of a window, has the share of the 128 particles."""
    base = dataclasses.replace(BASE, model=dataclasses.replace(BASE.model, width=width))
    networks = ("tlio", "ctin", "ionet", "experts")
    assert tuple(experiments.method(name, base).model.width for name in networks) == widths
    for name in ("gru", "state_space", "ronin_lstm", "ronin_tcn", "imot", "ridi"):
        assert experiments.method(name, base).model.width is None
    for name in ("imot", "imot_text"):
        particles = None if width is None else 2 * width
        assert experiments.method(name, base).model.particles == particles


def test_a_frame_has_the_share_of_the_width_and_that_of_the_base_stays():
    for width, widths in ((16, 16), (4, 4), (None, None)):
        base = dataclasses.replace(BASE, model=dataclasses.replace(BASE.model, width=width))
        for name in ("eqnio_tlio", "eqnio_ronin"):
            assert experiments.method(name, base).model.frame_width == widths
        assert experiments.method("airimu", base).model.frame_width is None
    of_base = {"equivariance": "so2_frame", "frame_width": 5}
    base = dataclasses.replace(BASE, model=dataclasses.replace(BASE.model, **of_base))
    assert experiments.method("tlio", base).model.frame_width == 5
    assert experiments.method("eqnio_tlio", base).model.frame_width != 5
    assert experiments.method("airimu", base).model.frame_width is None


def test_the_search_for_a_width_ends_where_a_network_accepts_none(monkeypatch):
    """The error of the network names what is wrong."""
    monkeypatch.setattr(experiments, "accepts", lambda network, option, value: False)
    assert experiments.scaled_size(("width",), BASE, name="ctin") == {"width": 6}
    with pytest.raises(InputError, match="width must be even"):
        experiments.method("ctin", BASE)


def test_a_system_is_its_network_with_the_main_options_of_its_recipe():
    """Fields that no budget changes."""
    published = set(experiments.SYSTEMS) - {f"trunk_{name}" for name in experiments.OTHER_BLOCKS}
    for name in published:
        system = experiments.SYSTEMS[name]
        config = experiments.method(name, BASE)
        recipe = configuration.load(f"baselines/{name}")
        assert recipe.model.name == config.model.name == system.network
        for field in system.options:
            assert getattr(config.model, field) == getattr(recipe.model, field)
        for field in system.loss:
            assert getattr(config.loss, field) == getattr(recipe.loss, field)
        sees_body = config.data.window_rotation == "body_axes"
        assert sees_body == (config.model.corrector == "airimu")
        of_heading = experiments.method(name, configuration.load("pedestrian_windows"))
        configuration.validate(of_heading, name)
        data = dataclasses.replace(BASE.data, window_rotation="single")
        turned_whole = experiments.method(name, dataclasses.replace(BASE, data=data))
        assert turned_whole.data.window_rotation == ("body_axes" if sees_body else "single")


def test_a_corrector_has_all_losses_of_its_recipe_and_true_motions_to_learn_from():
    recipe = configuration.load("baselines/airimu")
    for name in ("tables/networks_walks", "tables/networks_oxiod"):
        base = configuration.load(name)
        config = experiments.method("airimu", base)
        bound = dataclasses.replace(recipe.loss, outlier_sigmas=base.loss.outlier_sigmas)
        assert config.loss == bound
        assert config.optim.clip_norm == recipe.optim.clip_norm
        assert config.optim.weight_decay == recipe.optim.weight_decay
        changes = config.augment
        assert changes.tilt_degrees == 0 and changes.rocking_share == 0
        assert changes.vertical_gain == (1, 1)
        assert changes.mirror_share == base.augment.mirror_share
        assert base.augment.tilt_degrees > 0
        configuration.validate(config, name)


def test_every_block_of_the_trunk_has_a_row_with_the_same_loss_and_size():
    names = ["trunk", *(f"trunk_{block}" for block in experiments.OTHER_BLOCKS)]
    configs = [experiments.method(name, BASE) for name in names]
    networks = [models.from_config(config.model) for config in configs]
    blocks = typing.get_args(typing.get_type_hints(Trunk)["block"])
    assert sorted(network.block for network in networks) == sorted(blocks)
    assert {network.width for network in networks} == {networks[0].width}
    assert {config.loss for config in configs} == {BASE.loss}


def test_only_networks_with_memory_learn_on_segments_with_as_many_seconds_in_a_batch():
    optim = dataclasses.replace(BASE.optim, batch_size=128)
    base = dataclasses.replace(BASE, optim=optim, segments=SegmentTraining(6.0))
    for name in make.networks(TablesConfig("comparison", methods="all")):
        config = experiments.method(name, base)
        remembers = name in ("gru", "state_space", "ronin_lstm", "ronin_tcn")
        assert (config.segments.seconds, config.optim.batch_size) == (
            (6.0, 21) if remembers else (0.0, 128)
        )
    few = dataclasses.replace(base, optim=dataclasses.replace(optim, batch_size=2))
    assert experiments.method("gru", few).optim.batch_size == 1
    without = dataclasses.replace(base, segments=SegmentTraining())
    assert experiments.method("gru", without).optim.batch_size == 128


def test_published_figures_are_those_of_the_measured_dataset():
    names = ("gnio", "tlio")
    rows = experiments.comparison(BASE, "oxiod", "unseen", names).rows
    assert [row.published for row in rows] == [0.71, 2.54]
    experiment = experiments.comparison(dataclasses.replace(BASE, dataset="oxiod"), "tyrex", "test")
    assert {row.published for row in experiment.rows} == {None}
    assert experiment.source == "no published figure for this split"
