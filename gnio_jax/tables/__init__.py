"""Reproduction of the paper's tables: comparison of networks, contribution of each part, and errors
at rest."""
