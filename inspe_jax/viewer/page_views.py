"""What a report page shows that needs more than figures: a photograph, and the scene to turn."""

from typing import Any

from inspe_jax.report.page import PageViews
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.viewshed import Visibility, sight_in
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout
from inspe_jax.viewer.scene3d import Scene3D
from inspe_jax.viewer.server import AccessRules, quiet, serve
from inspe_jax.viewer.still import still_view


def scene3d_page(scene: Scene, layout: Layout, conditions: Conditions, frame: int) -> str:
    """An HTML page with one frame of a scene and what a layout sees of it, to turn and zoom."""
    # No browser may connect: the page is a file.
    server = serve(AccessRules("127.0.0.1", browsers=0), 0)
    try:
        scene3d = Scene3D(server.scene, scene)
        scene3d.draw_users(frame)
        sight = sight_in(scene, layout, frame, conditions=conditions)
        scene3d.draw_voxels(sight, (Visibility.HIDDEN, Visibility.OUT_OF_VIEW))
        scene3d.draw_layout(conditions.layout(layout))
        look_from(server.initial_camera, scene)
        return server.scene.as_html()
    finally:
        with quiet():
            server.stop()


def look_from(camera: Any, scene: Scene, back: float = 1.0) -> None:
    """Point a camera at the whole scene from the south and from above; ``back`` scales its
    distance."""
    radius = scene.voxels.radius
    camera.position = (0.0, -1.05 * back * radius, 0.95 * back * radius)
    camera.look_at = (0.0, -0.08 * radius, 0.0)


VIEWS = PageViews(still_view, scene3d_page)
