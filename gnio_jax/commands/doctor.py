"""`gnio doctor`: installed packages, and datasets, networks and caches."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json as json_format
import platform
import re
from dataclasses import dataclass
from pathlib import Path

from gnio_jax.commands import console, options
from gnio_jax.errors import InputError

EXTRAS = ("bags", "excel", "idol", "onnx", "rerun", "torch")
"""Extras of gnio-jax that a user may want."""
PACKAGES = ("jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy", "scipy", "h5py")


@dataclass(frozen=True)
class DoctorOptions:
    json: bool = False
    """Print it as JSON."""


def doctor(request: DoctorOptions, _call: options.Call) -> None:
    """Show what is installed and found here: packages, devices, datasets, networks, caches.

    A missing part is not an error. Extras are parts of gnio-jax that need further packages. Include
    the output when you ask for help. A dataset is looked for in $GNIO_DATA/NAME, then in data/NAME.

    examples:
      {prog}
      GNIO_DATA=~/recordings {prog}
      {prog} --json
    """
    facts = {
        "gnio_jax": f"{_version('gnio-jax')} in {Path(__file__).parents[1]}",
        "python": f"{platform.python_version()} on {platform.system()} {platform.machine()}",
        "packages": ", ".join(map(_version, PACKAGES)),
        **_extras(),
        **_devices(),
        **_find_places(),
    }
    if request.json:
        print(json_format.dumps(facts, indent=2, ensure_ascii=False))
        return
    console.say(console.pairs(facts.items()))


def _version(name: str) -> str:
    try:
        return f"{name} {importlib.metadata.version(name)}"
    except importlib.metadata.PackageNotFoundError:
        return f"{name} is not installed"


def _extras() -> dict[str, str]:
    """Whether the packages of each extra are installed, or how to install them."""
    requirements = importlib.metadata.requires("gnio-jax") or []
    facts = {}
    for extra in EXTRAS:
        marked = [line for line in requirements if re.search(rf"extra == ['\"]{extra}['\"]", line)]
        names = [re.split(r"[^\w.-]", line)[0] for line in marked]
        missing = [name for name in names if "not installed" in _version(name)]
        remedy = f"lacks {', '.join(missing)}: pip install 'gnio-jax[{extra}]'"
        facts[f"extra {extra}"] = remedy if missing else ", ".join(map(_version, names))
    return facts


def _devices() -> dict[str, str]:
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)  # as in every command with the filter
    if problem := console.lacking_device():
        return {"devices": f"none: {problem}"}
    kinds = [
        " ".join(dict.fromkeys((device.platform, device.device_kind))) for device in jax.devices()
    ]
    third = float(jnp.asarray(1.0, jnp.float64) / 3.0)
    counts = ", ".join(f"{kinds.count(kind)} × {kind}" for kind in dict.fromkeys(kinds))
    facts = {"devices": counts, "float64": "works" if third == 1 / 3 else "does not work"}
    if jax.default_backend() == "cpu" and Path("/proc/driver/nvidia").exists():
        facts["gpu"] = "there is a driver, but JAX sees no GPU: pip install 'jax[cuda13]'"
    return facts


def _find_places() -> dict[str, str]:
    """Datasets whose folder exists, networks, runs, caches."""
    import jax

    from gnio_jax import data, networks
    from gnio_jax.data.hdf5 import cache_folder

    facts = {}
    for name in data.names():
        with contextlib.suppress(InputError):
            location = str(data.find_root(name)) if data.get(name).needs_root else "computed"
            facts[f"dataset {name}"] = location
    try:
        facts["networks"] = ", ".join(networks.list_networks())
    except InputError as error:
        facts["networks"] = f"none: {error}"
    try:
        facts["newest run"] = str(networks.newest_run())
    except InputError as error:
        facts["newest run"] = f"none: {error}"
    compiled = jax.config.values["jax_compilation_cache_dir"]
    facts["compiled programs"] = compiled or "not kept: the cache's folder cannot be written"
    return facts | {"recordings read": str(cache_folder())}
