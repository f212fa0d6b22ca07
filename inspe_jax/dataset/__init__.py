"""Data sets of frames: made, written and read, as OPV2V and its Infra-Set variant have them."""

from inspe_jax.dataset.folders import Dataset, Scenario
from inspe_jax.dataset.folders import open_dataset as open
from inspe_jax.dataset.formats.opv2v.reader import read_frame
from inspe_jax.dataset.formats.opv2v.writer import write_frame, write_protocol
from inspe_jax.dataset.generate import Made, generate
from inspe_jax.dataset.plan import Generation, ScenarioPlan
from inspe_jax.dataset.protocol import load_generation
from inspe_jax.dataset.statistics import Statistics, statistics
from inspe_jax.simulation.frame import Frame, Image, Scan, Station, Thing
from inspe_jax.simulation.recorder import Server

__all__ = [
    "Dataset",
    "Frame",
    "Generation",
    "Image",
    "Made",
    "Scan",
    "Scenario",
    "ScenarioPlan",
    "Server",
    "Station",
    "Statistics",
    "Thing",
    "generate",
    "load_generation",
    "open",
    "read_frame",
    "statistics",
    "write_frame",
    "write_protocol",
]
