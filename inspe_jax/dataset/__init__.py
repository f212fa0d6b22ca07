"""Data sets of frames: written and read in the formats of OPV2V and its Infra-Set variant."""

from inspe_jax.dataset.folders import Dataset, Scenario
from inspe_jax.dataset.folders import open_dataset as open
from inspe_jax.dataset.opv2v import write_frame, write_protocol
from inspe_jax.dataset.opv2v_reader import read_frame
from inspe_jax.dataset.record import Frame, Image, Scan, Station, Thing
from inspe_jax.dataset.stats import Statistics, statistics

__all__ = [
    "Dataset",
    "Frame",
    "Image",
    "Scan",
    "Scenario",
    "Station",
    "Statistics",
    "Thing",
    "open",
    "read_frame",
    "statistics",
    "write_frame",
    "write_protocol",
]
