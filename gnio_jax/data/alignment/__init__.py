"""Alignment of an IMU with a tracker: clocks, mounting and attitude from one recording."""
