"""Heights of the ground from an elevation model: GeoTIFF, ASCII grid, or a tile of SRTM or DTED,
but no format that refers to other files or addresses. Only the part around the place is read."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

from inspe_jax.core.errors import InspeError, error_at, needs
from inspe_jax.core.files import check_input
from inspe_jax.scene.georeference import wgs84
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.terrain import HIGHEST, LOWEST, laid_on, lattice

MOST = 4096  # most cells a side that are read around a place, or that one block has
DRIVERS = {
    **dict.fromkeys((".tif", ".tiff"), "GTiff"),
    ".asc": "AAIGrid",
    ".hgt": "SRTMHGT",
    **dict.fromkeys((".dt0", ".dt1", ".dt2"), "DTED"),
}
"""GDAL's driver for each suffix of the files that are read."""
METRES = ("", "m", "metre", "metres", "meter", "meters")  # most files name no unit


def with_elevation(
    place: Intersection, path: str | os.PathLike[str], radius: float
) -> Intersection:
    """A place on the ground of an elevation model, to :data:`~inspe_jax.scene.terrain.MARGIN`
    beyond ``radius`` [m] of its centre, on one level: a deck above another road is not known to a
    model.

    Heights [m] between the model's cells are bilinear. A file that names no projection has that of
    the place, or world coordinates where the place has none either. Raises InspeError if rasterio
    or pyproj is missing, the file can't be read, only one of the two says where on the Earth it is,
    or the file is no elevation model in metres or does not cover the radius.
    """
    _, at = lattice(place.center, radius)
    heights = _heights(place, Path(path), at)
    known = np.isfinite(heights)
    inside = np.hypot(*(at - place.center[:2]).T) <= radius
    if not known[inside].all():
        share = known[inside].mean()
        raise InspeError(
            f"{path}: has heights for {share:.0%} of the ground within {radius:g} m of "
            f"{place.name}; take a model that covers it, or a smaller radius"
        )
    notes = (*place.notes, f"heights of the ground from {Path(path).name}")
    # Beyond the radius some may be missing.
    return replace(laid_on(place, np.column_stack([at, heights])[known], radius), notes=notes)


def _heights(
    place: Intersection, path: Path, at: Float[np.ndarray, "N 2"]
) -> Float[np.ndarray, " N"]:
    """Heights [m] at points, NaN where the model has none."""
    check_input(path)
    if path.suffix.lower() not in DRIVERS:
        raise InspeError(f"{path}: an elevation model is {', '.join(DRIVERS)}")
    with needs("elevation models need rasterio", "geo"), _own_proj():
        import rasterio
        import rasterio.windows
    wrong = f"{path}: not an elevation model that GDAL reads"
    with (
        error_at(wrong, rasterio.errors.RasterioError),
        _own_proj(),
        rasterio.open(path, driver=DRIVERS[path.suffix.lower()]) as model,
    ):
        _check(model, path)
        points = _in_projection(place, path, model, at)
        a, b, c, d, e, f = tuple(~model.transform)[:6]
        x, y = points.T
        # Whole numbers are in the middle of cells.
        row, column = d * x + e * y + f - 0.5, a * x + b * y + c - 0.5
        window = rasterio.windows.Window(*_window(model, row, column, path))
        values = model.read(1, window=window, masked=True)
        scale, offset = model.scales[0], model.offsets[0]
    cells = np.ma.filled(values.astype(float), np.nan) * scale + offset
    here = [row - window.row_off, column - window.col_off]
    heights = map_coordinates(cells, here, order=1, cval=np.nan, prefilter=False)
    known = heights[np.isfinite(heights)]
    if len(known) and not (known.min() > LOWEST and known.max() < HIGHEST):
        raise InspeError(
            f"{path}: has heights of {known.min():,.0f} to {known.max():,.0f} m here; if some "
            "stand for no data, name them so in the file: gdal_translate -a_nodata VALUE"
        )
    return np.asarray(heights)


def _check(model: Any, path: Path) -> None:
    """Raise InspeError where a raster is no elevation model that can be read in parts."""
    unit = str(model.units[0] or "").strip().lower()
    nowhere = model.crs is None and model.transform == model.transform.identity()
    whole = max(rows * columns for rows, columns in model.block_shapes)
    for wrong, words in (
        (model.count != 1, f"has {model.count} bands, as a picture; an elevation model has one"),
        (nowhere, "does not say where it lies: it has no geotransform"),
        (unit not in METRES, f"has heights in {unit}, not in metres; convert it first"),
        (
            whole > MOST**2,
            f"is stored in blocks of more than {MOST} × {MOST} cells, which are read whole; store "
            "it in tiles: gdal_translate -co TILED=YES",
        ),
    ):
        if wrong:
            raise InspeError(f"{path}: {words}")


def _in_projection(place: Intersection, path: Path, model: Any, at: np.ndarray) -> np.ndarray:
    if model.crs is None:
        return at if place.georeference is None else at - place.georeference.shift
    if place.georeference is None:
        raise InspeError(
            f"{path}: is in {model.crs.to_string()}, and {place.name} does not say where on the "
            "Earth it is; take a map with a projection, or a model in the map's own coordinates "
            "without one"
        )
    return wgs84(model.crs.to_wkt(), place.georeference.to_degrees(at), back=True)


def _window(model: Any, row: np.ndarray, column: np.ndarray, path: Path) -> list[int]:
    """First column and row of the cells around points, and how many there are of each."""
    ends = []
    for at, size in ((row, model.height), (column, model.width)):
        low, high = np.floor(at.min()) - 1, np.ceil(at.max()) + 2
        if not (np.isfinite([low, high]).all() and high > 0 and low < size):
            raise InspeError(
                f"{path}: does not cover this place; is it of another region, or in another "
                "projection than it names?"
            )
        ends.append((max(int(low), 0), min(int(high), size)))
    if max(high - low for low, high in ends) > MOST:
        raise InspeError(
            f"{path}: has more than {MOST} cells a side around this place; resample it, as to 0.5 m"
        )
    (top, bottom), (left, right) = ends
    return [left, top, right - left, bottom - top]


@contextmanager
def _own_proj() -> Iterator[None]:
    """GDAL with the projections that came with it: importing SUMO names those of SUMO instead."""
    names = [name for name in ("PROJ_DATA", "PROJ_LIB") if "sumo" in os.environ.get(name, "")]
    kept = {name: os.environ.pop(name) for name in names}
    try:
        yield
    finally:
        os.environ.update(kept)
