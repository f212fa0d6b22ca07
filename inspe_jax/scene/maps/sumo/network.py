"""SUMO's road networks, read from a file or converted by netconvert from another map.

World coordinates are those of the map that a network was made from. SUMO shifts its networks so
that they begin at (0, 0); that shift is undone here. It is kept for geographic projections, whose
coordinates are millions of metres.
"""

import atexit
import functools
import gzip
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax import SAXException

import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError, missing_extra, needs
from inspe_jax.core.files import cached_by_file, check_xml, digest_of
from inspe_jax.scene.georeference import Georeference

NET_SUFFIXES = (".net.xml", ".net.xml.gz")
OSM_SUFFIXES = (".osm", ".osm.xml", ".osm.gz", ".osm.xml.gz")
SUMO = "(SUMO)"
"""How the source of a place ends that was read from a SUMO network."""
GEOGRAPHIC = 20_000.0
"""A network moved by more than this [m] was projected from latitudes and longitudes."""

_ALWAYS = (
    *("--sidewalks.guess", "true", "--crossings.guess", "true"),
    *("--no-turnarounds.except-deadend", "true"),
)
_HOW = {
    ".xodr": ("--opendrive-files", *("--offset.disable-normalization", "true"), *_ALWAYS),
    ".osm": (
        "--osm-files",
        *("--geometry.remove", "true", "--junctions.join", "true", "--ramps.guess", "true"),
        *("--tls.guess-signals", "true", "--tls.discard-simple", "true", "--tls.join", "true"),
        *("--osm.sidewalks", "true", *_ALWAYS),
    ),
}
"""Options of netconvert for each kind of map. It guesses sidewalks where a map has none."""


@dataclass(frozen=True, eq=False)
class RoadNet:
    """A network: the ``file`` that SUMO can run on, sumolib's ``net``, and ``shift`` [m].

    World coordinates are the network's less ``shift``.
    """

    name: str
    source: str
    file: Path
    net: Any
    shift: Float[np.ndarray, "2"]

    @functools.cached_property
    def georeference(self) -> Georeference | None:
        """Its projection; None if it has none, as a network that was drawn by hand."""
        if not self.net.hasGeoProj():
            return None
        x, y = np.array(self.net.getLocationOffset()) - self.shift
        return Georeference(self.net._location["projParameter"], (float(x), float(y)))

    def to_world(self, points: Any) -> np.ndarray:
        """Points (N, 2 or 3) of the network in world coordinates (N, 3); height 0 if not given."""
        at = np.array([(*p, 0.0)[:3] for p in points], float).reshape(-1, 3)
        return at - [*self.shift, 0.0]


@cached_by_file(8)
def load_net(path: Path) -> RoadNet:
    """The network of a .net.xml, .osm or .xodr file, cached while the file does not change.

    Raises InspeError if SUMO or the file is missing, if it is another kind of file, or if it has no
    roads.
    """
    with needs("SUMO networks and OpenStreetMap need sumolib", "sumo"):
        import sumolib
    is_net = path.name.lower().endswith(NET_SUFFIXES)
    if is_net:
        _check(path, "net")
    file = path.resolve() if is_net else _converted(path)
    try:
        net = sumolib.net.readNet(
            str(file), withInternal=True, withPedestrianConnections=True, lxml=False
        )
    except (SAXException, KeyError, ValueError, AttributeError, TypeError) as error:
        raise InspeError(f"{path}: not a SUMO network: missing or wrong: {error}") from error
    if not any(edge.getFunction() == "" for edge in net.getEdges()):
        raise InspeError(f"{path}: the network has no roads")
    moved = np.array(net.getLocationOffset(), float)
    shift = moved if np.abs(moved).max() <= GEOGRAPHIC else np.zeros(2)
    return RoadNet(path.name.split(".")[0], path.name, file, net, shift)


def _check(path: Path, root: str) -> None:
    """Raise InspeError if a file is not XML with this root element."""
    with gzip.open(path) if path.name.lower().endswith(".gz") else path.open("rb") as f:
        check_xml(f, str(path), root)


# ── SUMO's own programs ─────────────────────────────────────────────────────


@functools.cache
def _folder() -> Path:
    """A folder for converted networks, which is removed when this process ends."""
    folder = tempfile.TemporaryDirectory(prefix="inspe_jax_", ignore_cleanup_errors=True)
    atexit.register(folder.cleanup)
    return Path(folder.name)


def _converted(path: Path) -> Path:
    """The network that netconvert makes of a map."""
    kind = ".xodr" if path.suffix.lower() == ".xodr" else ".osm"
    if kind == ".osm":
        _check(path, "osm")
    source, *options = _HOW[kind]
    made = _folder() / f"{digest_of(path)[:16]}.net.xml"
    if not made.exists():
        part = made.with_suffix(".part.xml")
        run("netconvert", [source, str(path), "-o", str(part), *options], f"{path}")
        part.rename(made)
    return made


def program(name: str) -> str:
    """The path of a SUMO program: in the installed package, beside Python, or on PATH."""
    folders = [str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)]
    with suppress(ImportError):
        import sumo

        folders.insert(0, os.path.join(sumo.SUMO_HOME, "bin"))
    found = shutil.which(name, path=os.pathsep.join(folders))
    if found is None:
        raise missing_extra(f"{name} is missing", "sumo")
    return found


def run(name: str, arguments: Sequence[str], where: str) -> None:
    """Run a SUMO program. Raises InspeError with the first error that it prints."""
    done = subprocess.run(
        [program(name), *arguments], capture_output=True, text=True, stdin=subprocess.DEVNULL
    )
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if line.startswith("Error")]
        reason = said[0].removeprefix("Error: ") if said else f"exit status {done.returncode}"
        raise InspeError(f"{where}: {name} failed: {reason}")
