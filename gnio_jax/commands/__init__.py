"""The command lines: each reads typed options and makes one call into the package."""

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")  # before JAX is imported
