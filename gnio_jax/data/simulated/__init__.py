"""Simulated walks."""
