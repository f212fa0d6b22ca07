"""Through the selected sensor: a camera's picture or a LiDAR's points, and what it has of road
users, by the embedded recorder. A thread of its own records; what is out of date is not begun.
"""

import base64
import io
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import viser
from jaxtyping import Float
from PIL import Image as Pillow

from inspe_jax.core.errors import InspeError
from inspe_jax.core.words import counted
from inspe_jax.dataset.points_in_boxes import world_points
from inspe_jax.placement.problem import Case
from inspe_jax.report.page import template
from inspe_jax.scoring.detection import BANDS, EDITION, FEW
from inspe_jax.scoring.targets import pixel_density_at
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.sensors import CameraSpec, Spec
from inspe_jax.simulation.embedded.recorder import LiveSensor
from inspe_jax.simulation.frame import Image, RoadUserBox, Scan
from inspe_jax.simulation.recorder import Recording
from inspe_jax.viewer.job_queue import PATIENCE, JobQueue

PIXELS = 320 * 240  # number of pixels of a picture, unless the camera itself has fewer
LISTED = 6  # number of road users that are listed, the nearest ones
QUALITY = 88  # of a picture, of 100
_TEMPLATE = template("viewer", "sensor_view.html.j2")


class SensorShot(NamedTuple):
    """What is recorded: sensor ``s`` of a layout, or none, in frame ``t``. ``held``: it is being
    moved. Its unit then has no mast, and those of the others are where they were."""

    layout: Layout
    s: int | None
    t: int
    held: bool


class SensorView:
    """A folder of the page with the view of a sensor.

    ``seen`` is the newest recording. ``show_points`` is called, on the view's thread, with the
    points of a LiDAR in the world (N, 3) [m]; with None if there are none to show.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        folder: Any,
        case: Case,
        failed: Callable[[Exception], None],
        show_points: Callable[[Float[np.ndarray, "N 3"] | None], None],
    ) -> None:
        """``folder`` is filled. ``failed`` gets errors, except that the recorder is not there,
        which the page says in place of a picture."""
        self.case = case
        self.seen: Image | Scan | None = None
        self._folder, self._show_points = folder, show_points
        self._recording = JobQueue(failed)
        self._live: tuple[Layout, int, LiveSensor] | None = None
        self._newest: SensorShot | None = None
        with folder:
            self.on = gui.add_checkbox("Live", True, hint="Record what the selected sensor gets")
            self.picture = gui.add_html("")

        @self.on.on_update
        async def _(event: Any) -> None:
            newest, self._newest = self._newest, None
            if newest is not None and event.client is not None:
                self.look(newest)

    def look(self, at: SensorShot) -> None:
        """Show this, unless it is shown already or something newer comes before it is begun."""
        newest = self._newest
        if newest is not None and newest.layout is at.layout and newest[1:] == at[1:]:
            return
        self._newest = at
        self._recording.submit(lambda: self._look(at), key="look")

    def close(self, *, wait: bool) -> None:
        """Record nothing more; with ``wait``, come back when the last recording has ended."""
        self._recording.close(PATIENCE if wait else 0, wait=wait)

    def _look(self, at: SensorShot) -> None:
        seen, page = None, ""
        try:
            if self.on.value and at.s is not None:
                pose = np.array(at.layout.poses[at.s], float)
                boxes, seen = self._live_sensor(at, at.s).record(at.t, pose)
                spec = self.case.conditions.spec(at.layout.sensors[at.s].spec)
                page = _page(spec, boxes, seen)
        except InspeError as e:
            page = _TEMPLATE.render(wrong=str(e))
        except Exception:
            self._newest = None  # to try again
            raise
        finally:
            self.picture.content, self.seen = page, seen
            which = "a sensor" if at.s is None else f"sensor {at.s + 1}"
            self._folder.label = f"Through {which}"
            self._show_points(world_points(seen).T if isinstance(seen, Scan) else None)

    def _live_sensor(self, at: SensorShot, s: int) -> LiveSensor:
        """The selected sensor: while it is held, in the surroundings that it was taken up in."""
        if self._live is not None:
            layout, of, sensor = self._live
            there = layout is at.layout or (at.held and layout.sensors == at.layout.sensors)
            if there and of == s:
                return sensor
        case, small = self.case, Recording(image_size=image_size(at.layout.sensors[s].spec))
        sensor = LiveSensor(case.scene, at.layout, s, case.conditions, small)
        self._live = at.layout, s, sensor
        return sensor


def _page(spec: Spec, boxes: Sequence[RoadUserBox], seen: Image | Scan) -> str:
    pose = np.asarray(seen.pose, float)
    at = np.array([box.center for box in boxes]).reshape(-1, 3)
    away = np.linalg.norm(at - pose[:3], axis=1)
    if isinstance(seen, Image):
        file = io.BytesIO()
        Pillow.fromarray(seen.rgb).save(file, "jpeg", quality=QUALITY)
        image = f"data:image/jpeg;base64,{base64.b64encode(file.getvalue()).decode()}"
        shown = np.count_nonzero(np.asarray(seen.pixels))
        summary = f"{shown} of {len(boxes)} road users are in the picture"
        sharp = np.where(away <= spec.grid.reach, pixel_density_at(spec, pose, at), np.nan)
        share = np.asarray(seen.share)
        there = share > 0
        much = [f"{_sharpness(d)}; {1 - s:.0%} hidden" for d, s in zip(sharp, share, strict=True)]
    else:
        image, returns = "", np.asarray(seen.returns)
        least = FEW if seen.speeds is None else 1  # a radar's echo is enough
        enough = np.count_nonzero(returns >= least)
        summary = f"{len(seen.points):,} points; {enough} of {len(boxes)} road users have {least:g}"
        summary += " or more"
        there, much = returns > 0, [counted(int(points), "point") for points in returns]
    nearest = [k for k in np.argsort(away, kind="stable") if there[k]][:LISTED]
    rows = [dict(kind=boxes[k].kind, distance=away[k], much=much[k]) for k in nearest]
    summary += "; the nearest:"
    return _TEMPLATE.render(wrong="", image=image, summary=summary, rows=rows)


def _sharpness(density: float) -> str:
    """Pixels per metre in words, with the band of IEC 62676-4:2025; those of the camera itself,
    whose picture here is smaller."""
    if np.isnan(density):
        return "beyond its reach"
    if density <= 0:
        return "at the picture's edge"
    band = [name for name, least in BANDS[EDITION].items() if density >= least][-1:]
    return ", ".join([f"{int(density)} px/m", *band])


def image_size(spec: Spec) -> tuple[int, int] | None:
    """Width and height of a camera's pictures, so that they have about :data:`PIXELS`."""
    if not isinstance(spec, CameraSpec):
        return None
    scale = min(1.0, float(np.sqrt(PIXELS / (spec.width * spec.height))))
    return max(1, round(spec.width * scale)), max(1, round(spec.height * scale))
