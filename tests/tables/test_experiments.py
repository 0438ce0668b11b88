"""What the tables vary, and what they do not."""

import dataclasses

import pytest

from gnio_jax import config as configuration
from gnio_jax.config import LossConfig
from gnio_jax.tables import experiments
from gnio_jax.training.task import create_model
from tests.support.reports import BASE


@pytest.mark.parametrize(
    "make",
    [
        experiments.components,
        experiments.gates,
        experiments.bank_sizes,
        lambda base: experiments.comparison(base, "test"),
    ],
)
def test_rows_differ_in_the_network_alone(make):
    """Every row can be built, two are never the same, those of a name are; loss and regularisation
    apart, only the network differs. Every checkpoint is chosen by one criterion."""
    seen = {}
    for row in make(BASE).rows:
        assert create_model(row.config) is not None
        assert seen.setdefault(row.name, row.config) == row.config
        optim = dataclasses.replace(
            row.config.optim, clip_norm=BASE.optim.clip_norm, weight_decay=BASE.optim.weight_decay
        )
        assert optim.best_by == "squared_error"
        same = dataclasses.replace(
            BASE, optim=dataclasses.replace(BASE.optim, best_by="squared_error")
        )
        assert (
            dataclasses.replace(row.config, model=BASE.model, loss=BASE.loss, optim=optim) == same
        )
        assert row.config.model.name != "gnio" or (row.config.loss, row.config.optim) == (
            same.loss,
            same.optim,
        )
    assert len(set(map(str, seen.values()))) == len(seen)


@pytest.mark.parametrize(
    "epochs, batch, held",
    [(200, 128, 10), (200, 1024, 10), (24, 1024, 10), (24, 128, 1.25), (8, 1024, 4), (2, 512, 1)],
)
def test_tlio_is_held_for_the_published_steps_or_half_of_the_run(epochs, batch, held):
    base = dataclasses.replace(
        BASE, optim=dataclasses.replace(BASE.optim, epochs=epochs, batch_size=batch)
    )
    assert experiments.method("tlio", base).loss.log_std_from_epoch == held


def test_rows_of_one_name_are_one_run_in_every_table():
    tables = [
        make(BASE)
        for make in (
            experiments.components,
            experiments.gates,
            experiments.bank_sizes,
        )
    ]
    made = [row for table in (*tables, experiments.comparison(BASE, "test")) for row in table.rows]
    by_name = {}
    for row in made:
        assert by_name.setdefault(row.name, row.config) == row.config
    assert len(by_name) < len(made)


def test_rows_are_the_published_configurations():
    gates = {row.label: row.config.model for row in experiments.gates(BASE).rows}
    assert (
        all(model.bank_size == 0 for model in gates.values()) and gates["tanh × exp"].scale == "exp"
    )
    banks = {row.label: row.config.model for row in experiments.bank_sizes(BASE).rows}
    assert all(model.head == "linear" for model in banks.values())
    assert [create_model(row.config).bank_size for row in experiments.bank_sizes(BASE).rows] == [
        0,
        16,
        32,
        64,
        128,
    ]
    parts = [(row.config.model.name, row.published) for row in experiments.components(BASE).rows]
    assert parts == [("tlio", 2.40), ("gnio", None), ("gnio", 1.98), ("gnio", 1.84), ("gnio", 1.66)]


@pytest.mark.parametrize("network", [*experiments.METHODS, "imot_text"])
def test_losses_and_regularisation_are_those_of_the_published_recipes(network):
    row = experiments.method(network, BASE)
    budget = dataclasses.replace(
        row.optim,
        clip_norm=BASE.optim.clip_norm,
        weight_decay=BASE.optim.weight_decay,
        best_by="loss",
    )
    assert budget == BASE.optim and (row.data, row.augment) == (BASE.data, BASE.augment)
    if network == "gnio":
        assert row.loss is BASE.loss and row.optim == dataclasses.replace(
            BASE.optim, best_by="squared_error"
        )
        return
    recipe = configuration.validate(configuration.load(f"configs/baselines/{network}.yaml"))
    assert recipe.model.name == network
    optim, loss = dataclasses.replace(BASE.optim, epochs=200), LossConfig(outlier_sigmas=10.0)
    published = dataclasses.replace(BASE, optim=optim, loss=loss)
    assert experiments.loss(network, published) == recipe.loss
    assert (row.optim.clip_norm, row.optim.weight_decay) == (
        recipe.optim.clip_norm,
        recipe.optim.weight_decay,
    )
    assert create_model(recipe) is not None
