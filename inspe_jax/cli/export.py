"""A plan to hand on: `inspe export`."""

from pathlib import Path

from inspe_jax.cli.claims import claims
from inspe_jax.cli.common import busy, note, out, scene_and_layout
from inspe_jax.cli.options import command, prices
from inspe_jax.core.files import write_text


@command()
def export(
    source: str,
    sensors: str,
    *,
    files: list[Path] | None = None,
    price: list[str] | None = None,
    force: bool = False,
) -> None:
    """Write a plan in coordinates of the Earth, for maps, surveyors and contractors.

    The scene must be of a map with a projection, as OpenStreetMap. Degrees are those of WGS 84;
    azimuths are clockwise from true north; heights are above the ground at the foot of the pole.
    The GeoJSON can be edited in a map and read back in place of a layout file.

    Examples:

    - `inspe export city.npz better/layout.yaml --out plan.geojson --out plan.kml`
    - `inspe export city.npz Cam-d1/L-d1 --out bill.csv --price paper-camera=900`
    - `inspe score city.npz plan.geojson`  (reads it back)

    Args:
        files (--out FILE.geojson|kml|csv): A file to write; repeat it for more. GeoJSON and
            KML: poles, sensors with height, azimuth and tilt, and what each looks at. CSV: a
            bill of materials. If not given, plan.geojson.
    """
    from inspe_jax.report.handover import PLAN_FORMATS

    given = prices(price)
    paths = files or [Path("plan.geojson")]
    for path in paths:
        claims.file(path, PLAN_FORMATS, force=force)
    with busy(f"reading {source}"):
        world, placed = scene_and_layout(source, sensors, None)
    texts = [PLAN_FORMATS[p.suffix.lower()](placed, world.intersection, given) for p in paths]
    place = world.intersection
    if place.georeference and (doubt := place.georeference.doubt(place.center)):
        note(doubt)
    for path, text in zip(paths, texts, strict=True):
        write_text(path, text)
        out.print(f"wrote {path}")
