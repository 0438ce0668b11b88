#!/usr/bin/env bash
# Make the network that comes with gnio-jax anew: GNIO_DATA=recordings scripts/pedestrian.sh [RUNS]
#
# GNIO_DATA holds the folders tyrex and indoor_location. It trains on all of their walks, and a network
# for each half of them, in which people and floors are whole, which has not seen the other half. The
# filter is calibrated by what those say of walks that they have not seen.
set -euo pipefail
runs=${1:-runs}

gnio train --config pedestrian --workdir "$runs/pedestrian" --resume
for half in 0 1; do
  gnio train --config pedestrian --data.train-split "all-${half}of2" \
    --workdir "$runs/pedestrian_half$half" --optim.epochs 4 --resume
done
gnio calibrate --workdir "$runs/pedestrian" --out "$runs/pedestrian_calibrated" \
  --out-of-fold "$runs/pedestrian_half0" "$runs/pedestrian_half1"
