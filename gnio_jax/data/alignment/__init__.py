"""An IMU laid on what a tracker saw of it: clocks, mounting and attitude from one recording."""
