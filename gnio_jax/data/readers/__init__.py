"""One module for each published layout: its files, columns, units, frames, splits and traps."""

from gnio_jax.data.dataset import Dataset
from gnio_jax.data.readers import (
    blackbird,
    comma2k19,
    csv_files,
    euroc,
    idol,
    indoor_location,
    kitti,
    onavdata,
    oxiod,
    pedlocdata,
    ridi,
    ronin,
    tlio,
    tyrex,
)
from gnio_jax.data.simulated.walks import SYNTHETIC

DATASETS: dict[str, Dataset] = {
    dataset.name: dataset
    for dataset in (
        blackbird.DATASET,
        comma2k19.DATASET,
        csv_files.DATASET,
        *euroc.DATASETS,
        idol.DATASET,
        indoor_location.DATASET,
        kitti.DATASET,
        onavdata.DATASET,
        oxiod.DATASET,
        pedlocdata.DATASET,
        ridi.DATASET,
        ronin.DATASET,
        SYNTHETIC,
        tlio.DATASET,
        tyrex.DATASET,
    )
}
"""Every dataset by its name."""
