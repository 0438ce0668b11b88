"""What is installed here, and what of the user's data and weights is found: plain values."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any, NamedTuple

from packaging.requirements import Requirement

from gnio_jax.errors import InputError

PROJECT = "gnio-jax"
SHOWN = ("jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy", "scipy", "h5py", "bokeh")
"""Packages whose versions are told."""
DEVELOPMENT = ("dev", "test", "reference")
"""Extras of those who change the package."""


class Finding(NamedTuple):
    """What `gnio doctor` tells."""

    version: str
    python: str
    packages: dict[str, str | None]
    """Name -> version; None where it is missing."""
    extras: dict[str, list[str]]
    """Extra -> what it lacks: nothing where it is complete."""
    devices: dict[str, Any]
    """`kinds` (what JAX sees, "cpu: 2"), `default`, `float64`, `problem`."""
    datasets: dict[str, str]
    """Those that are found -> their folder."""
    looked_in: list[str]
    weights: dict[str, Any]
    """`packages` (name -> place), `newest_run`, `problem`."""
    caches: dict[str, str]
    """Of compiled programs and of recordings -> where."""
    remarks: list[str]
    """What a user may want to change."""


def find(data_root: str | None = None) -> Finding:
    """Look at everything; nothing that is missing is an error."""
    packages, extras = _versions(), _extras()
    devices, weights = _devices(), _weights()
    bases = [data_root] if data_root else [os.environ.get("GNIO_DATA"), "data"]
    looked_in = [base for base in bases if base]
    found = Finding(
        version=_version(PROJECT) or "not installed",
        python=f"{platform.python_version()} on {platform.system()} {platform.machine()}",
        packages=packages,
        extras=extras,
        devices=devices,
        datasets=_datasets(looked_in),
        looked_in=looked_in,
        weights=weights,
        caches=_caches(),
        remarks=[],
    )
    return found._replace(remarks=_remarks(found))


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _versions() -> dict[str, str | None]:
    needed = [each.name for each in _requirements() if each.marker is None]
    missing = [name for name in needed if _version(name) is None]
    return {name: _version(name) for name in dict.fromkeys([*SHOWN, *missing])}


def _requirements() -> list[Requirement]:
    """Of the installed gnio-jax; none where only its sources are there."""
    try:
        lines = importlib.metadata.requires(PROJECT) or []
    except importlib.metadata.PackageNotFoundError:
        lines = []
    return [Requirement(line) for line in lines]


def _extras() -> dict[str, list[str]]:
    requirements = [each for each in _requirements() if each.marker is not None]
    try:
        names = importlib.metadata.metadata(PROJECT).get_all("Provides-Extra") or []
    except importlib.metadata.PackageNotFoundError:
        names = []
    return {
        extra: [
            each.name
            for each in requirements
            if each.marker is not None
            and each.marker.evaluate({"extra": extra})
            and _version(each.name) is None
        ]
        for extra in names
        if extra not in DEVELOPMENT
    }


def _devices() -> dict[str, Any]:
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)  # as every command that filters
    try:
        devices = jax.devices()
        third = float(jnp.asarray(1.0, jnp.float64) / 3.0)
    except RuntimeError as error:  # a platform that was asked for and is not there
        problem = " ".join(str(error).split())
        return {"kinds": [], "default": None, "float64": False, "problem": problem}
    kinds = [f"{device.platform}: {device.device_kind}" for device in devices]
    return {
        "kinds": kinds,
        "default": jax.default_backend(),
        "float64": third == 1.0 / 3.0,
        "problem": None,
    }


def _datasets(bases: list[str]) -> dict[str, str]:
    """Folders named as datasets, in the first base that has one."""
    from gnio_jax.data import registry

    found = {}
    for name in registry.names():
        if not registry.get(name).needs_root:
            found[name] = "computed"
            continue
        for base in bases:
            if (place := registry.folder_in(name, Path(base))) is not None:
                found.setdefault(name, str(place))
    return found


def _weights() -> dict[str, Any]:
    from gnio_jax import config as configuration
    from gnio_jax.pretrained import finding

    try:
        packages, problem = finding.packages(), None
    except InputError as error:
        packages, problem = {}, str(error)
    try:
        newest: str | None = str(configuration.newest_run())
    except InputError:
        newest = None
    places = {name: str(place) for name, place in packages.items()}
    return {"packages": places, "newest_run": newest, "problem": problem}


def _caches() -> dict[str, str]:
    import jax

    from gnio_jax.data import cache

    compiled = jax.config.values["jax_compilation_cache_dir"]
    return {"compiled programs": compiled or "none", "recordings": str(cache.folder())}


def _remarks(found: Finding) -> list[str]:
    remarks = []
    missing = [name for name, version in found.packages.items() if version is None]
    if missing:
        remarks.append(f"not installed: {', '.join(missing)}; pip install gnio-jax brings them")
    if found.devices["problem"]:
        remarks.append(f"JAX sees no device: {found.devices['problem']}")
    elif not found.devices["float64"]:
        remarks.append("float64 does not work on this device, and the filter needs it")
    if found.devices["default"] == "cpu" and Path("/proc/driver/nvidia").exists():
        remarks.append("there is an NVIDIA driver, but JAX sees no GPU: pip install 'jax[cuda13]'")
    if found.weights["problem"]:
        remarks.append(found.weights["problem"])
    if not found.weights["packages"] and found.weights["newest_run"] is None:
        line = "no weights: gnio train --config quickstart makes a first network"
        remarks.append(f"{line}, $GNIO_WEIGHTS names folders of packages")
    if found.caches["compiled programs"] == "none":
        remarks.append(
            "every start compiles anew: JAX_COMPILATION_CACHE_DIR=DIR keeps what is compiled"
        )
    return remarks
