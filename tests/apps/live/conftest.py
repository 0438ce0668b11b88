"""A run whose trackers are compiled once, and `gnio live` as a person types it."""

import signal

import pytest

from gnio_jax.config import DataConfig, FilterSettings, ModelConfig, TrainConfig
from gnio_jax.filtering import tracker as trackers
from tests.support import tiny_run
from tests.support.live_streams import RATE

PATIENCE = 300
"""s, after which a test waits for what never comes."""
SETTINGS = FilterSettings(measurements={"zero_velocity": {"std": 0.02}})


@pytest.fixture(autouse=True)
def patience():
    def give_up(*_):
        pytest.fail(f"nothing has come for {PATIENCE} s")

    before = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(PATIENCE)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="package")
def run(tmp_path_factory):
    config = TrainConfig(
        data=DataConfig(rate=RATE), model=ModelConfig(name="tiny"), filter=SETTINGS
    )
    with tiny_run.registry_entry():
        yield tiny_run.save(tmp_path_factory.mktemp("home") / "run", config)


@pytest.fixture(scope="package", autouse=True)
def programs():
    """Trackers of the one run that take the same steps share what is compiled."""
    compiled, compile_programs = {}, trackers.compile_programs

    def once(predict, core, *settings):
        if repr(settings) not in compiled:
            compiled[repr(settings)] = compile_programs(predict, core, *settings)
        return compiled[repr(settings)]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trackers, "compile_programs", once)
        yield


@pytest.fixture
def follow(gnio, run):
    """What `gnio live` prints of lines on standard input."""
    return lambda lines, *words: gnio("live", *words, "--network", run, lines=lines)
