"""The command lines: typed options in, one call into the package."""
