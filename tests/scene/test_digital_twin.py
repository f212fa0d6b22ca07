"""A place from a mesh: its ground and solids against the mesh itself, by Embree and on paper."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
import worlds
from shapely.geometry import box
from worlds import LIDAR, box_triangles, crossing, place_sensors

import inspe_jax
from inspe_jax.core.errors import InspeError
from inspe_jax.scene.maps.digital_twin import Y_UP, read_mesh, with_mesh
from inspe_jax.scene.statics import tree
from inspe_jax.scene.street import map_bodies, statics_of
from inspe_jax.scene.terrain import lattice_faces
from inspe_jax.scene.traffic.frames import Snapshot, pack_frames
from inspe_jax.visibility.queries import line_of_sight

trimesh = pytest.importorskip("trimesh", reason="meshes need trimesh: extra [geo]")

CENTER, RADIUS = (310.0, -120.0, 0.0), 24.0
HOUSES = [((14.0, 17.0), (8.0, 10.0), 7.0), ((-16.0, 15.0), (6.0, 6.0), 4.0)]
"""Middles, lengths and widths, and heights [m], about the centre."""
CROWN = ((-15.0, -14.0), 2.5, 5.0)
"""Middle, radius, and height of the middle over the ground [m]."""
GANTRY = ((0.0, 18.0), (16.0, 1.0), (5.0, 6.0))
"""Middle, length and width, and between which heights over the road [m]."""


def place():
    return crossing(center=CENTER)


def height(x, y):
    """The ground [m] about the centre: a slope of 6 % with a brow."""
    return 30.0 + 0.06 * np.minimum(x, 5.0) - 0.03 * np.maximum(x - 5.0, 0.0) + 0.0 * y


def ground_faces(step=2.0, reach=60.0):
    side = np.arange(-reach, reach + 0.1, step)
    x, y = np.meshgrid(side, side, indexing="ij")
    at = np.stack([x + CENTER[0], y + CENTER[1], height(x, y)], -1)
    return at.reshape(-1, 3)[lattice_faces(len(side), len(side))]


def faces():
    """The ground, two houses, a crown without a trunk, a gantry over the road, and a parked van."""
    found = [ground_faces()]
    for (x, y), size, up in HOUSES:
        foot = (x + CENTER[0], y + CENTER[1], height(x, y) - 2.0)
        found.append(box_triangles(foot, (*size, up + 2.0), 0.0))
    (x, y), radius, up = CROWN
    ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    found.append(np.array(ball.triangles) + [x + CENTER[0], y + CENTER[1], height(x, y) + up])
    (x, y), size, (low, high) = GANTRY
    foot = (x + CENTER[0], y + CENTER[1], height(x, y) + low)
    found.append(box_triangles(foot, (*size, high - low), 0.0))
    van = (CENTER[0] - 3.0, CENTER[1] - 14.0, height(-3.0, -14.0))
    found.append(box_triangles(van, (2.0, 5.0, 2.2), 0.0))
    return np.concatenate(found)


def written(path, triangles, colour=None, look=None):
    """A mesh file in the axes of its format."""
    if path.suffix in Y_UP:
        triangles = np.stack([triangles[..., 0], triangles[..., 2], -triangles[..., 1]], -1)
    index = np.arange(3 * len(triangles)).reshape(-1, 3)
    mesh = trimesh.Trimesh(triangles.reshape(-1, 3), index, visual=look, process=False)
    if colour is not None:
        mesh.visual.face_colors = colour
    mesh.export(path)
    return path


def built(place):
    """A scene of the twin without traffic."""
    size = dict(radius=RADIUS, voxel=1.0, frames=1, density="none")
    return inspe_jax.build_scene(place, statics="map", terrain="ground", **size)


def within(bodies, area):
    """The bodies within an area, and the ground that they cover."""
    own = [one for one in bodies if area.covers(one.polygon)]
    return own, shapely.unary_union([one.polygon for one in own])


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    return written(tmp_path_factory.mktemp("twin") / "twin.ply", faces(), (180, 90, 60, 255))


def test_ground_and_solids_on_paper(twin):
    found = with_mesh(place(), twin, RADIUS)
    x, y, z = found.ground_points.T
    near = np.hypot(x - CENTER[0], y - CENTER[1]) < RADIUS
    assert z[near] == pytest.approx(height(x - CENTER[0], y - CENTER[1])[near], abs=0.15)
    assert found.center[2] == pytest.approx(30.0, abs=0.05)
    assert {one.kind for one in found.bodies} == {"solid"}
    standing = [one for one in found.bodies if one.base == 0]
    hung = [one for one in found.bodies if one.base > 0]
    for (cx, cy), size, up in HOUSES:
        half = np.array(size) / 2
        at = np.array([cx, cy]) + CENTER[:2]
        own, area = within(standing, box(*(at - half - 1), *(at + half + 1)))
        assert area.symmetric_difference(box(*(at - half), *(at + half))).area < 6.0
        tops = [one.height + found.ground(one.middle[None])[0] for one in own]
        assert np.array(tops) == pytest.approx(height(cx, cy) + up, abs=0.3)
    crown = shapely.Point(*(np.array(CROWN[0]) + CENTER[:2])).buffer(CROWN[1])
    own, area = within(hung, crown.buffer(0.8))
    assert area.area == pytest.approx(crown.area, rel=0.15)
    assert min(one.base for one in own) == pytest.approx(CROWN[2] - CROWN[1], abs=0.4)
    assert max(one.height for one in own) == pytest.approx(CROWN[2] + CROWN[1], abs=0.4)
    road = place().regions
    over = [one for one in hung if one.polygon.intersects(road[next(iter(road))])]
    assert over  # the gantry stays over the road, and the van does not
    assert min(one.base for one in over) > 4.5
    assert "twin.ply" in " ".join(found.notes)


def test_a_house_is_solid_however_its_faces_are_made(tmp_path):
    """8 × 8 m, the roof's diagonal on the middles of cells: all of it stands on the ground."""

    def house(x, y, size=8.0, low=28.0, high=37.0):
        foot = (CENTER[0] + x, CENTER[1] + y, low)
        return box_triangles(foot, (size, size, high - low), 0.0)

    a, b, c, d = ((x, y) for x in (-16.25, 16.25) for y in (-16.25, 16.25))
    plain, double, shells = [house(*a)], [house(*b), house(*b)[:, ::-1]], [house(*c)]
    shells.append(house(*c, size=7.4, low=28.3, high=36.7))
    faces = [ground_faces(), *plain, *double, *shells, house(*d)[:, ::-1]]  # the last is inside out
    found = with_mesh(place(), written(tmp_path / "house.ply", np.concatenate(faces)), RADIUS)
    for at in (a, b, c, d):
        middle = np.array(at) + CENTER[:2]
        own, area = within(found.bodies, box(*(middle - 5.25), *(middle + 5.25)))
        assert own
        assert all(one.base == 0 for one in own)
        assert 64.0 <= area.area <= 8.5**2  # to the middles of cells, half a cell further
        level = found.ground(middle[None])[0]
        assert max(one.height for one in own) == pytest.approx(37.0 - level, abs=0.4)


def test_thin_things_stand_and_hang(tmp_path):
    """A single sheet on the ground stands; a trunk carries a crown, which hangs around it."""
    x, y = CENTER[0] - 16.0, CENTER[1] + 15.25
    fence = np.array([[[x, y, 28.0], [x + 8, y, 28.0], [x + 8, y, 32.0]],
                      [[x, y, 28.0], [x + 8, y, 32.0], [x, y, 32.0]]])  # fmt: skip
    trunk = box_triangles((CENTER[0] + 15.25, CENTER[1] - 15.25, 28.0), (0.4, 0.4, 6.0), 0.0)
    ball = np.array(trimesh.creation.icosphere(subdivisions=3, radius=2.5).triangles)
    crown = ball + [CENTER[0] + 15.25, CENTER[1] - 15.25, 36.0]
    parts = [ground_faces(), fence, trunk, crown]
    found = with_mesh(place(), written(tmp_path / "thin.ply", np.concatenate(parts)), RADIUS)
    north = [one for one in found.bodies if one.middle[1] > CENTER[1]]
    south = [one for one in found.bodies if one.middle[1] < CENTER[1]]
    assert north
    assert all(one.base == 0 for one in north)
    stood, hung = (
        shapely.unary_union([one.polygon for one in south if (one.base > 0) == above]).area
        for above in (False, True)
    )
    assert 0 < stood <= 2.0
    assert hung == pytest.approx(np.pi * 2.5**2 - stood, rel=0.15)


def test_formats_agree_and_colours_are_those_of_materials_and_textures(tmp_path, twin):
    """glTF has y up and numbers of single precision; vertices have places in a picture."""
    from PIL import Image

    plain = read_mesh(written(tmp_path / "twin.obj", faces()))
    assert plain.world == pytest.approx(read_mesh(twin).world, abs=2e-3)
    red = trimesh.visual.material.PBRMaterial(baseColorFactor=[200, 40, 30, 255])
    picture = Image.fromarray(np.full((4, 4, 3), (20, 180, 60), np.uint8))
    green = trimesh.visual.material.PBRMaterial(baseColorTexture=picture)
    for name, material, colour in (("red", red, (200, 40, 30)), ("green", green, (20, 180, 60))):
        uv = np.full((3 * len(faces()), 2), 0.5)
        look = trimesh.visual.TextureVisuals(uv=uv, material=material)
        found = read_mesh(written(tmp_path / f"{name}.glb", faces(), look=look))
        assert found.world == pytest.approx(plain.world, abs=2e-3)
        assert np.abs(found.colour.astype(int) - colour).max() <= 3


def test_a_solid_that_somebody_brushes_stays(twin):
    """And bodies of the map are left out for those of the mesh; a note says how many."""
    own = tree((CENTER[0] + 16, CENTER[1] - 16), radius=1.5, height=6.0, base=2.5)
    found = with_mesh(replace(place(), bodies=(own,)), twin, RADIUS)
    assert {one.kind for one in found.bodies} == {"solid"}
    assert "1 bodies of the map left out" in " ".join(found.notes)
    wall = max(map_bodies(found, RADIUS), key=lambda one: one.polygon.area)
    person = Snapshot(
        np.array([[*wall.outline[0], 31.0]]), np.zeros(1), np.full((1, 3), 0.5),
        np.full(1, 3, np.int8), np.zeros(1, np.int32), np.zeros((1, 3)),
    )  # fmt: skip
    assert wall in statics_of("map", found, RADIUS, pack_frames([person], 1.0))


def test_lines_of_sight_are_those_of_the_mesh(twin, monkeypatch):
    """Of reduced prisms on 97 % of (sensor, voxel) as of all triangles by Embree: the cells are
    0.5 m wide, and so are the edges of shadows uncertain."""
    found = with_mesh(place(), twin, RADIUS)
    scene = built(found)
    at = [(19.5, 17.0), (-20.5, 15.5), (-18.5, -17.5), (3.0, 21.0)]
    xy = np.array(at) + CENTER[:2]
    z = found.ground(xy) + [4.0, 3.0, 6.0, 7.0]
    layout = place_sensors(*[(LIDAR, [*p, h, 0, 0, 0]) for p, h in zip(xy, z, strict=True)])
    ours = line_of_sight(scene, layout, 0)
    kept, van = faces(), shapely.box(-5, -17, -1, -11)
    middle = kept.mean(1)[:, :2] - CENTER[:2]
    kept = kept[~shapely.contains_xy(van, *middle.T) | (np.ptp(kept[..., 2], 1) < 0.2)]
    monkeypatch.setattr(worlds, "triangles", lambda *_: kept)
    theirs = worlds.embree_line_of_sight(scene, layout, 0)
    assert theirs.mean() < 0.95
    assert (ours == theirs).mean() > 0.97


def test_recordings_show_the_mesh_itself(twin, tmp_path):
    """Its faces above the ground in their colour, in place of the solids; also when reloaded."""
    pytest.importorskip("embreex", reason="recordings need Embree: extra [dataset]")
    from inspe_jax.simulation.embedded.static_bodies import Material
    from inspe_jax.simulation.embedded.static_world import build_static_world

    found = with_mesh(place(), twin, RADIUS)
    scene = built(found)
    inspe_jax.save_scene(scene, tmp_path / "twin.npz")
    again = inspe_jax.load_scene(tmp_path / "twin.npz")
    crown = faces()[len(ground_faces()) + 24 :][:1280]
    for one in (scene, again):
        world = build_static_world(one.intersection, RADIUS, np.zeros((0, 4)), one.statics)
        shown = world.triangles[world.material == Material.SURVEYED] + one.intersection.center
        middles = ({tuple(c) for c in of.mean(1).round(2)} for of in (crown, shown))
        assert next(middles) <= next(middles)
        assert not (world.material == Material.BUILDING).any()
        colour = world.colour[world.material == Material.SURVEYED]
        assert np.abs(colour - (np.array([180, 90, 60]) / 255) ** 2.2).max() < 0.02
    bare = build_static_world(found, RADIUS, np.zeros((0, 4)))
    assert not (bare.material == Material.SURVEYED).any()


def test_what_is_wrong_is_said(tmp_path):
    own = place()
    house = box_triangles((CENTER[0] + 15, CENTER[1] + 15, 0.0), (5, 5, 5), 0.0)
    (tmp_path / "text.ply").write_text("no mesh")
    for at, file, words in (
        (own, written(tmp_path / "far.ply", faces() + [900.0, 0, 0]), "the map.s coordinates"),
        (own, written(tmp_path / "house.ply", house), "the mesh must have the roads"),
        (replace(own, regions={}), written(tmp_path / "twin.ply", faces()), "must have the roads"),
        (own, tmp_path / "text.ply", "not a mesh that trimesh reads"),
        (own, tmp_path / "twin.stl", r"a mesh is \.glb"),
        (own, tmp_path / "missing.ply", r"missing\.ply"),
    ):
        with pytest.raises(InspeError, match=words):
            with_mesh(at, file, RADIUS)
