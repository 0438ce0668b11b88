"""What pyproject.toml cannot say: configs/ lies at the top of the tree and is packaged with it."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["gnio_jax*"]), "gnio_jax.configs"],
    package_dir={"gnio_jax.configs": "configs"},
    package_data={
        "gnio_jax": ["py.typed"],
        "gnio_jax.configs": ["*.yaml", "*/*.yaml"],
        "gnio_jax.apps.live": ["*.html"],
        "gnio_jax.evaluation": ["*.html", "*.js"],
        "gnio_jax.weights": ["*.zip", "*/*"],
    },
)
