"""Walks that are computed, not recorded."""
