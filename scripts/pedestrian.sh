#!/usr/bin/env bash
# Make the network that comes with gnio-jax anew: GNIO_DATA=recordings scripts/pedestrian.sh [RUNS]
#
# GNIO_DATA holds the folders tyrex and indoor_location. The network is trained on all of their walks. A
# second one has not seen one of the two people: its filter is calibrated on walks of that person, and
# the network takes it over.
set -euo pipefail
runs=${1:-runs}

gnio train --config pedestrian --workdir "$runs/pedestrian" --resume
gnio train --config pedestrian --data.train-split all-1of2 --optim.epochs 4 \
  --workdir "$runs/pedestrian_half" --resume
gnio calibrate --workdir "$runs/pedestrian_half"
python - "$runs" <<'PYTHON'
import dataclasses
import shutil
import sys
from pathlib import Path

from gnio_jax import config

runs = Path(sys.argv[1])
out = runs / "pedestrian_calibrated"
evaluated = shutil.ignore_patterns("eval")  # with the filter as it was
shutil.copytree(runs / "pedestrian", out, ignore=evaluated, dirs_exist_ok=True)
own, other = (config.load(runs / name / "config.yaml") for name in
              ("pedestrian", "pedestrian_half_calibrated"))
config.save(out / "config.yaml", dataclasses.replace(own, filter=other.filter, workdir=str(out)))
shutil.copy(runs / "pedestrian_half_calibrated" / "calibration.json", out)
PYTHON
