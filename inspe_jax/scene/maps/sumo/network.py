"""SUMO's programs, and the networks that netconvert makes of other maps."""

import atexit
import functools
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from contextlib import suppress
from importlib.resources import files
from pathlib import Path

import shapely
from shapely.geometry import Point, Polygon

from inspe_jax.core.errors import InspeError, missing_extra
from inspe_jax.core.files import check_kind, check_xml, digest_of
from inspe_jax.scene.maps.openstreetmap.extract import opened

NET_SUFFIXES = (".net.xml", ".net.xml.gz")
OSM_SUFFIXES = (".osm", ".osm.xml", ".osm.gz", ".osm.xml.gz")
SUMO = "(SUMO)"  # how the source of a place ends that was read from a SUMO network
GEOGRAPHIC = 20_000.0  # a network moved by more [m] was projected from latitudes and longitudes
_GUESSED = "--sidewalks.guess true --crossings.guess true --no-turnarounds.except-deadend true"
_OPTIONS = {
    "opendrive": f"--offset.disable-normalization true {_GUESSED}",
    "osm": "--geometry.remove true --junctions.join true --ramps.guess true --osm.sidewalks true "
    "--output.street-names true "
    f"--tls.guess-signals true --tls.discard-simple true --tls.join true {_GUESSED}",
}
"""Options of netconvert for each kind of map. It guesses sidewalks where a map has none."""
SIDES = ("right", "left")  # of the road, that traffic of an extract may drive on
LANELET = re.compile(rb"""v=["']lanelet["']""")  # only maps of Lanelet2 have such a tag


@functools.cache
def _folder() -> Path:
    """A folder for converted networks, which is removed when this process ends."""
    folder = tempfile.TemporaryDirectory(prefix="inspe_jax_", ignore_cleanup_errors=True)
    atexit.register(folder.cleanup)
    return Path(folder.name)


def network_file(path: Path, side: str | None = None) -> tuple[Path, list[str]]:
    """The file of a network, or of what netconvert makes of another map, with notes. Traffic of an
    extract drives on a ``side``, or by its country. Raises InspeError if it is of another kind."""
    name, kind = path.name.lower(), "osm"
    if name.endswith((".xodr", *NET_SUFFIXES)):
        kind = "opendrive" if name.endswith(".xodr") else "net"
    if not name.endswith(".gz"):
        check_kind(path, b"<osm")
    if kind != "opendrive":
        with opened(path) as f:
            check_xml(f, str(path), kind)
    if kind == "net":
        return path.resolve(), []
    used, note = driving_side(path, side) if kind == "osm" else ("right", "")
    made = _folder() / f"{digest_of(path)[:16]}_{used}.net.xml"
    if not made.exists():
        part = made.with_suffix(".part.xml")
        given = [f"--{kind}-files", str(path), "-o", str(part), *_OPTIONS[kind].split()]
        given += ["--lefthand", "true"] if used == "left" else []
        try:
            run("netconvert", given, f"{path}")
        except InspeError as error:
            with opened(path) as f:
                if kind == "osm" and any(map(LANELET.search, f)):
                    wrong = "is a map of Lanelet2, which is not read; convert it to OpenDRIVE"
                    raise InspeError(f"{path}: {wrong}") from error
            raise
        part.rename(made)
    return made, [note] if note else []


def driving_side(path: Path, wanted: str | None) -> tuple[str, str]:
    """The side of :data:`SIDES` that traffic of an extract drives on, and a note on why: the one
    that is wanted, or that of the country where its first point lies."""
    if wanted is not None:
        return wanted, f"traffic drives on the {wanted}, as --driving-side says"
    at = Point()
    with opened(path) as f, suppress(StopIteration, ValueError):  # netconvert says what is wrong
        first = next(one for _, one in ET.iterparse(f, ["start"]) if one.tag == "node")
        at = Point(float(first.get("lon", "")), float(first.get("lat", "")))
    table = files("inspe_jax.scene.maps.openstreetmap").joinpath("left_hand.toml").read_text()
    rings = tomllib.loads(table).items()
    lands = ((name, Polygon(shapely.from_wkt(f"LINESTRING ({ring})"))) for name, ring in rings)
    where = next((name for name, land in lands if land.covers(at)), "")
    side, other = reversed(SIDES) if where else SIDES
    why = f"as in {where or 'most countries'}" if at.is_valid and not at.is_empty else "by default"
    remedy = f"if not so, give --driving-side {other}"
    return side, f"traffic drives on the {side}, {why}; {remedy}"


def run(name: str, arguments: Sequence[str], where: str) -> None:
    """Run a SUMO program of the installed package, beside Python, or on PATH. Raises InspeError if
    there is none, and with the first error that it prints."""
    folders = [str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)]
    with suppress(ImportError):
        import sumo

        folders.insert(0, os.path.join(sumo.SUMO_HOME, "bin"))
    program = shutil.which(name, path=os.pathsep.join(folders))
    if program is None:
        raise missing_extra(f"{name} is missing", "sumo")
    done = subprocess.run(
        [program, *arguments], capture_output=True, text=True, stdin=subprocess.DEVNULL
    )
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if line.startswith("Error")]
        reason = said[0].removeprefix("Error: ") if said else f"exit status {done.returncode}"
        raise InspeError(f"{where}: {name} failed: {reason}")
