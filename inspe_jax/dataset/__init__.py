"""Data sets of frames: made, written and read, as OPV2V and its Infra-Set variant have them."""

from inspe_jax.dataset.folders import Dataset, Scenario
from inspe_jax.dataset.folders import open_dataset as open
from inspe_jax.dataset.generate import Made, generate
from inspe_jax.dataset.opv2v import write_frame, write_protocol
from inspe_jax.dataset.opv2v_reader import read_frame
from inspe_jax.dataset.plan import Generation, ScenarioPlan
from inspe_jax.dataset.protocol import load_generation
from inspe_jax.dataset.record import Frame, Image, Scan, Station, Thing
from inspe_jax.dataset.recorder import Server
from inspe_jax.dataset.stats import Statistics, statistics

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
