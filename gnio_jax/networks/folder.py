"""A trained network on the disk: one folder, whether it was just trained or is published.

    config.yaml           the settings
    weights.safetensors   the arrays by their paths, such as params/head/kernel
    README.md             the card of a published network

A published network may also be a zip of these files. Its card begins with facts, among them the
size and the SHA-256 of the other files. Everything is checked before it is used. Nothing is
unpacked to the disk, and nothing is executed. docs/weights.md has the format.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
import zipfile
import zlib
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
import yaml
from flax import linen as nn
from safetensors import SafetensorError
from safetensors.numpy import load as load_safetensors
from safetensors.numpy import save as save_safetensors

from gnio_jax import config as configuration
from gnio_jax import models
from gnio_jax.config import FilterSettings, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.files import fingerprint, replacing, replacing_folder
from gnio_jax.models.airimu import AirIMU, Corrector

CONFIG, WEIGHTS, CARD = "config.yaml", "weights.safetensors", "README.md"
HEADER = "gnio_jax"
"""Name of the text in the header of a run's weights: epoch, step, the filter's trained settings."""
SPLITS = "splits.yaml"
"""File of a run that lists the recordings of its splits."""
LARGEST = {CONFIG: 2**20, CARD: 2**20, WEIGHTS: 2**32}
"""Largest sizes in bytes (ours), because a small zip may unpack to any size."""
FORMAT, VERSION = "gnio-network", 1
BOUND = "---\n"
"""Line before and after the facts of a card."""
DAMAGED = "the package is damaged: fetch or publish it again"


class Card(NamedTuple):
    """The facts about a published network, with which its card begins."""

    name: str
    network: str
    """Name of the network in the registry of `gnio_jax.models`."""
    data: str
    """The training data, in the publisher's words."""
    license: str
    epoch: int
    step: int
    measured: str
    """The error that lists of networks show, in words; empty if there was no evaluation."""
    made_by: str
    """The program that published it, with its version."""
    files: dict
    """Size and SHA-256 of the other files, as `files.fingerprint` gives them."""


class NetworkSettings(NamedTuple):
    """A trained network without its arrays."""

    config: TrainConfig
    """Its section `filter` has the values that were trained."""
    epoch: int
    step: int
    digest: str
    """SHA-256 of its weights."""
    card: Card | None
    """None if it is not published."""


class TrainedNetwork(NamedTuple):
    """A trained network."""

    config: TrainConfig
    """Its section `filter` has the values that were trained."""
    model: nn.Module
    variables: Any
    epoch: int
    step: int
    path: Path | None = None
    """Its folder or zip, if it was read from the disk."""
    digest: str = ""
    """SHA-256 of its weights on the disk."""
    card: Card | None = None
    """None if it is not published."""
    corrector: Any = None
    """Variables of the corrector of `filter.corrector`, if they were written with the network."""

    @property
    def name(self) -> str:
        """The name that its publisher gave it, else that of its folder."""
        if self.card is not None:
            return self.card.name
        return self.config.model.name if self.path is None else name_of(self.path)


def name_of(path: Path) -> str:
    """The name of a network by its folder or zip."""
    return path.absolute().name.removesuffix(".zip")


def evaluations_folder(path: Path) -> Path:
    """The folder for the evaluations of a network: eval/ in the folder of a run. Nothing is written
    into a published network, so its evaluations are in evaluations/NAME."""
    published = path.is_file() or has_card(path)
    return Path("evaluations") / name_of(path) if published else path / "eval"


def has_card(path: Path) -> bool:
    """Whether a folder or zip has the card of a network; the card is not checked."""
    start = f"{BOUND}format: {FORMAT}\n".encode()
    try:
        return _read_start(path, CARD, len(start)) == start
    except InputError:
        return False


# Reading
# ------------------------------------------------------------------------------------------------


def read_network(path: Path) -> TrainedNetwork:
    """The network of a folder or zip with its trained variables.

    Raises `InputError` for a folder without a network or without weights yet, for files that are
    damaged, and for arrays that are not finite or do not fit the settings.
    """
    settings, weights = _read_files(path)
    model = models.from_experiment(settings.config, str(path / CONFIG))
    shapes = models.variable_shapes(model, settings.config.data.input_samples)
    template = {"params": shapes["params"], "batch_stats": shapes.get("batch_stats", {})}
    if settings.config.filter.corrector is not None and has_corrector(weights):
        samples = Corrector.before + 1 + Corrector.after
        template["corrector"] = models.variable_shapes(AirIMU(), samples)
    variables = from_bytes(weights, template, path / WEIGHTS)
    corrector = variables.pop("corrector", None)
    config, epoch, step, digest, card = settings
    return TrainedNetwork(config, model, variables, epoch, step, path, digest, card, corrector)


def has_corrector(weights: bytes) -> bool:
    """Whether a file of weights holds a corrector beside the network."""
    length = int.from_bytes(weights[:8], "little")
    return b'"corrector/params/' in weights[8 : 8 + length]


def read_settings(path: Path) -> NetworkSettings:
    """The settings of a network; its arrays are not checked. Raises `InputError` as
    `read_network` does."""
    return _read_files(path)[0]


def _read_files(path: Path) -> tuple[NetworkSettings, bytes]:
    """The settings and the weights of a network, as its card describes them if it has one."""
    card = read_card(path) if path.is_file() or has_card(path) else None
    if card is None and not (path / CONFIG).is_file():
        raise InputError(path, f"holds no network ({CONFIG} is missing)", "train one: gnio train")
    if card is None and not (path / WEIGHTS).is_file():
        remedy = "let gnio train finish its first epoch, or name another network"
        raise InputError(path, f"holds no weights ({WEIGHTS} is missing)", remedy)
    sizes = LARGEST if card is None else {name: card.files[name]["bytes"] for name in card.files}
    text, weights = (
        _read_file(path, name, min(sizes[name], LARGEST[name])) for name in (CONFIG, WEIGHTS)
    )
    for name, content in ((CONFIG, text), (WEIGHTS, weights)):
        if card is not None and fingerprint(content) != card.files[name]:
            problem = f"'{name}' is not the file that the card describes (SHA-256 differs)"
            raise InputError(path, problem, DAMAGED)
    source = str(path / CONFIG)
    try:
        config = configuration.parse(text.decode("utf-8"), source)
    except UnicodeDecodeError as error:
        raise InputError(source, f"cannot be read ({error})") from None
    epoch, step, settings = _read_header(weights, path / WEIGHTS)
    if settings != "null":
        config = configuration.parse(f"filter: {settings}", str(path / WEIGHTS), config)
    configuration.validate(config, source)
    if card is not None:
        epoch, step = card.epoch, card.step
    return NetworkSettings(config, epoch, step, hashlib.sha256(weights).hexdigest(), card), weights


def read_card(path: Path) -> Card:
    """The facts of a published network; its other files are not read. Raises `InputError`."""
    facts, _ = _split_card(path)
    where = path / CARD
    if facts.get("format") != FORMAT:
        raise InputError(where, "is not the card of a network", DAMAGED)
    if facts.get("version") != VERSION:
        problem = f"has format version {facts.get('version')!r}; this program reads {VERSION}"
        remedy = "publish its run again, or install the gnio-jax that made it"
        raise InputError(where, problem, remedy)
    if _digest(facts) != facts.get("sha256"):
        raise InputError(where, "its facts were changed (SHA-256 differs)", DAMAGED)
    for name, kind in get_type_hints(Card).items():
        value = facts.get(name)
        if type(value) is not kind or (isinstance(value, int) and not 0 <= value < 2**31):
            raise InputError(where, f"has no '{name}', or a wrong one", DAMAGED)
    files = facts["files"]
    sizes = [entry.get("bytes") for entry in files.values() if isinstance(entry, dict)]
    if files.keys() != {CONFIG, WEIGHTS} or [type(size) for size in sizes] != [int, int]:
        raise InputError(where, f"does not describe '{CONFIG}' and '{WEIGHTS}'", DAMAGED)
    return Card(*(facts[name] for name in Card._fields))


def read_text(path: Path) -> str:
    """The text of a card after its facts, Markdown. Raises `InputError`, also for a network that is
    not published."""
    if path.is_dir() and not has_card(path):
        raise InputError(path, "has no card", "gnio publish writes one")
    return _split_card(path)[1].strip()


def _split_card(path: Path) -> tuple[dict[str, Any], str]:
    """The facts of a card and its text."""
    try:
        content = _read_file(path, CARD, LARGEST[CARD]).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(path / CARD, f"cannot be read ({error})", DAMAGED) from None
    _, *parts = re.split(f"^{BOUND}", content, maxsplit=2, flags=re.MULTILINE)
    facts = configuration.parse_yaml(parts[0], str(path / CARD)) if len(parts) == 2 else None
    if not isinstance(facts, dict):
        raise InputError(path / CARD, "does not begin with the facts of a network", DAMAGED)
    return facts, parts[1]


def _digest(facts: dict[str, Any]) -> str:
    """The SHA-256 of all facts of a card except this digest."""
    others = {name: value for name, value in facts.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(others, sort_keys=True).encode()).hexdigest()


def _read_file(path: Path, name: str, most: int) -> bytes:
    """The content of a file of a folder or zip. Raises `InputError` if it has more than `most`
    bytes."""
    content = _read_start(path, name, max(most, 0) + 1)
    if len(content) > most:
        raise InputError(path, f"'{name}' is larger than {most} bytes", DAMAGED)
    return content


def _read_start(path: Path, name: str, count: int) -> bytes:
    """At most `count` bytes of a file of a folder or zip."""
    try:
        if path.is_dir():
            with (path / name).open("rb") as file:
                return file.read(count)
        with zipfile.ZipFile(path) as archive:
            entries = archive.namelist()
            folders = {entry.partition("/")[0] for entry in entries} - {"__MACOSX"}
            if name not in entries and len(folders) == 1:  # as a file manager packs a folder
                name = f"{folders.pop()}/{name}"
            method = archive.getinfo(name).compress_type
            if method not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise zipfile.BadZipFile(f"compression method {method}")  # none of `gnio publish`
            with archive.open(name) as file:
                return file.read(count)
    except (FileNotFoundError, KeyError):
        raise InputError(path, f"'{name}' is missing", DAMAGED) from None
    except (OSError, zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError) as error:
        raise InputError(path, f"'{name}' cannot be read ({error})", DAMAGED) from None


# The weights
# ------------------------------------------------------------------------------------------------


def to_bytes(variables: Any, header: dict[str, str] | None = None) -> bytes:
    """Variables as a safetensors file with a header of texts. The name of an array is its path,
    `params/head/kernel`."""
    arrays = {name: np.asarray(leaf, np.float32) for name, leaf in _name_leaves(variables).items()}
    return save_safetensors(arrays, header)


def from_bytes(content: bytes, template: Any, where: object) -> Any:
    """The variables of a file in the structure of `template` (arrays or shapes). Raises
    `InputError` if a name or a shape differs, or if a value is not finite."""
    try:
        tensors = load_safetensors(content)
    except (SafetensorError, ValueError, KeyError) as error:
        problem = f"cannot be read ({str(error)[:120]})"
        raise InputError(where, problem, "it must be a safetensors file") from None
    leaves = _name_leaves(template)
    for name in sorted(leaves.keys() | tensors.keys()):
        shape, expected = (
            list(tree[name].shape) if name in tree else None for tree in (tensors, leaves)
        )
        if shape != expected:
            problem = f"'{name}' has shape {shape}, and in the configured network {expected}"
            raise InputError(where, problem, "weights and settings must be of one network")
        if not np.isfinite(tensors[name]).all():
            remedy = "take another network, or train it again with a lower optim.learning_rate"
            raise InputError(where, f"'{name}' holds values that are not finite", remedy)
    arrays = [jnp.asarray(tensors[name], jnp.float32) for name in leaves]
    return jax.tree.unflatten(jax.tree.structure(template), arrays)


def _name_leaves(tree: Any) -> dict[str, Any]:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def _read_header(content: bytes, where: object) -> tuple[int, int, str]:
    """Epoch, step and settings of the filter (YAML, or null) in the header of a safetensors file,
    which is its length and JSON. The numbers are 0 where it does not have them."""
    try:
        length = int.from_bytes(content[:8], "little")
        texts = json.loads(content[8 : 8 + length]).get("__metadata__", {})
        run = json.loads(texts.get(HEADER, "{}"))
        return int(run.get("epoch", 0)), int(run.get("step", 0)), json.dumps(run.get("filter"))
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        problem = f"cannot be read ({str(error)[:120]})"
        raise InputError(where, problem, "it must be a safetensors file") from None


# The recordings that it was trained on
# ------------------------------------------------------------------------------------------------


def training_recordings(path: Path, config: TrainConfig, dataset: str) -> set[str]:
    """Names of the recordings of a dataset that a network was trained on; none if its folder does
    not list them."""
    try:
        splits = yaml.safe_load((path / SPLITS).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        return set()
    names = recordings_by_name(
        splits.get(config.data.train_split) if isinstance(splits, dict) else None
    )
    if config.datasets == (dataset,):
        return set(names)
    prefix = f"{dataset}/"
    return {name.removeprefix(prefix) for name in names if name.startswith(prefix)}


def recordings_by_name(recordings: Any) -> dict[str, int | None]:
    """Recordings and their lengths in samples; None if only the names are known."""
    if isinstance(recordings, dict):
        return {str(name): length for name, length in recordings.items()}
    return dict.fromkeys(map(str, recordings)) if isinstance(recordings, list) else {}


# Writing
# ------------------------------------------------------------------------------------------------


def write_network(folder: Path, network: TrainedNetwork) -> None:
    """Write settings and weights of a network into an existing folder."""
    configuration.save(folder / CONFIG, network.config)
    write_weights(folder, _all_variables(network), network.epoch, network.step)


def _all_variables(network: TrainedNetwork) -> Any:
    """The variables of a network and of its corrector, so that both can go to other people."""
    if network.corrector is None:
        return network.variables
    return {**network.variables, "corrector": network.corrector}


def write_weights(
    folder: Path, variables: Any, epoch: int, step: int, settings: FilterSettings | None = None
) -> None:
    """Write the weights of a run, whole or not at all, in the place of earlier ones. `settings` are
    those of the filter if they were trained with the network: config.yaml has those from which its
    training began. Raises `OSError` naming the file if the disk is full."""
    run: dict[str, Any] = {"epoch": epoch, "step": step}
    if settings is not None:
        run["filter"] = configuration.to_plain(settings)
    header = {HEADER: json.dumps(run)}  # one text, because safetensors writes several in any order
    with replacing(folder / WEIGHTS) as temporary:
        temporary.write_bytes(to_bytes(variables, header))


def write_published(path: Path, network: TrainedNetwork, card: Card, text: str) -> Card:
    """Write a published network, a zip if the name ends with .zip, else a folder, and return its
    card, which then describes its files. `text` is the card's Markdown. It is written whole or not
    at all and replaces an earlier one. Its settings contain no folders of this machine."""
    config = configuration.without_paths(network.config)
    if network.corrector is not None:  # it comes with the network, whatever its folder was
        name = Path(config.filter.corrector or "corrector").name
        config = dataclasses.replace(
            config, filter=dataclasses.replace(config.filter, corrector=name)
        )
    settings = configuration.to_yaml(config).encode()
    files = {CONFIG: settings, WEIGHTS: to_bytes(_all_variables(network))}
    card = card._replace(files={name: fingerprint(content) for name, content in files.items()})
    facts = {"format": FORMAT, "version": VERSION, **card._asdict()}
    facts["sha256"] = _digest(facts)
    files[CARD] = f"{BOUND}{configuration.to_yaml(facts)}{BOUND}\n{text}\n".encode()
    if path.suffix == ".zip":
        with replacing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
            for name, content in files.items():
                # With a date the bytes of the same network would differ.
                archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    else:
        with replacing_folder(path) as folder:
            for name, content in files.items():
                (folder / name).write_bytes(content)
    return card
