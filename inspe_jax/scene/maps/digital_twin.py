"""A mesh of a place, as from a survey or a digital twin: its ground, and what stands on it.

1. The mesh is looked at from above, on a grid of :data:`CELL`, whichever way its faces point.
2. In the regions the surface at the level around is the ground.
3. Where upright faces come down to it, the mesh stands there, and so does all that they enclose: it
   is solid from its highest surface to the ground.
4. What else is higher hangs, as a crown or a bridge: it is solid between its outer surfaces.
5. Cells of like heights are one prism. Recordings show the mesh itself.
"""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float, Int
from scipy import ndimage
from shapely.ops import unary_union

from inspe_jax.core.errors import InspeError, error_at, needs
from inspe_jax.core.files import check_input
from inspe_jax.scene.intersection import LOW, Intersection, Mesh
from inspe_jax.scene.maps.bodies import Shape, with_bodies
from inspe_jax.scene.terrain import MARGIN, laid_on

SUFFIXES = (".glb", ".gltf", ".ply", ".obj")
Y_UP = (".glb", ".gltf")  # formats whose second axis points up; that of the others is the third
CELL = 0.5  # edge of the cells that the mesh is looked at in [m]
LEVELS = np.array([*np.arange(0.0, 4.0, 0.5), *np.arange(4.0, 8.0), *np.arange(8.0, 1e3, 4.0)])
"""Cells are alike whose outer surfaces lie between the same of these heights [m]."""
MOST_FACES = 4_000_000  # more triangles near a place are refused
COVERED = 0.2  # a mesh must have the ground of so much of the regions
AROUND = 9.0  # the level of the ground around a point is that in a square of this edge [m]
AT_ONCE = 4_000_000  # so many pairs of a triangle and a cell are looked at together
STEEP = 0.5  # triangles are steep whose normals point less upward; walls are 0, roofs of 60° 0.5
STANDS = 1.0  # what comes down to this height over the ground stands on it [m]
MOST_SOLIDS = 5000  # more solids near a place are refused
SMALL = 3  # what covers fewer cells that touch is left out
GREY = (128, 128, 128)


def with_mesh(place: Intersection, path: str | os.PathLike[str], radius: float) -> Intersection:
    """A place on the ground of a mesh, with what stands on it as bodies of kind ``solid`` in place
    of those of its map.

    The mesh is in the map's coordinates [m], x east and z up, or y up and z south in glTF. What
    stands on lanes, crossings or footpaths, as a survey's road users, is cut off there. Raises
    InspeError if trimesh is missing, the file can't be read or has no triangles, the mesh has no
    ground in the regions of the place, or too many triangles or solids.
    """
    mesh = _near(read_mesh(path), place, radius + MARGIN, path)
    seen = _FromAbove(mesh, place, radius + MARGIN)
    stood = laid_on(place, _ground(place, seen, path), radius)
    shapes = list(_shapes(stood, seen))
    if len(shapes) > MOST_SOLIDS:
        raise InspeError(
            f"{path}: is {len(shapes):,} solids near {place.name}, of {MOST_SOLIDS:,} at most: "
            "every score takes them all; leave small things such as leaves and cables out of it"
        )
    notes = [*place.notes, f"ground and {len(shapes)} solids from {Path(path).name}"]
    if place.bodies:
        notes.append(f"{len(place.bodies)} bodies of the map left out for those of the mesh")
    found = with_bodies(stood, shapes, radius + MARGIN, notes)
    return replace(found, mesh=mesh, notes=tuple(notes))


def read_mesh(path: str | os.PathLike[str]) -> Mesh:
    """A mesh from a file of :data:`SUFFIXES`, z up. Raises InspeError as :func:`with_mesh`."""
    file = Path(path)
    if file.suffix.lower() not in SUFFIXES:
        raise InspeError(f"{path}: a mesh is {', '.join(SUFFIXES)}")
    check_input(file)
    with needs("meshes need trimesh", "geo"):
        import trimesh
    # Its readers raise whatever they run into.
    with error_at(f"{path}: not a mesh that trimesh reads", Exception):
        parts = list(_parts(trimesh.load_scene(file, process=False)))
    corners = np.concatenate([np.zeros((0, 3, 3)), *(corners for corners, _ in parts)])
    colours = np.concatenate([np.zeros((0, 3), np.uint8), *(colours for _, colours in parts)])
    if not len(corners) or not np.isfinite(corners).all():
        raise InspeError(f"{path}: has no triangles, or coordinates that are not finite")
    if file.suffix.lower() in Y_UP:
        corners = np.stack([corners[..., 0], -corners[..., 2], corners[..., 1]], -1)
    origin = corners.reshape(-1, 3).mean(0).round()
    return Mesh(origin, (corners - origin).astype(np.float32), colours)


def _parts(scene: Any) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Triangles and colours of each geometry of a scene, where the scene puts it."""
    for node in scene.graph.nodes_geometry:
        turn, name = scene.graph[node]
        geometry = scene.geometry[name]
        if not hasattr(geometry, "triangles"):  # points and lines
            continue
        corners = np.asarray(geometry.triangles, float)
        yield corners @ np.asarray(turn)[:3, :3].T + np.asarray(turn)[:3, 3], _colours(geometry)


def _colours(geometry: Any) -> np.ndarray:
    """The colour of each face: of its vertices' places in a texture, its material, or its own."""
    visual, faces = geometry.visual, np.asarray(geometry.faces)
    if getattr(visual, "kind", None) == "texture":
        colours = np.asarray(visual.to_color().vertex_colors)
        if colours.shape[:1] != (len(geometry.vertices),):  # a material without a texture
            colours = np.tile(np.asarray(visual.material.main_color), (len(geometry.vertices), 1))
        found = colours[faces][..., :3].mean(1)
    elif getattr(visual, "kind", None) in ("face", "vertex"):
        found = np.asarray(visual.face_colors)[:, :3]
    else:
        found = np.tile(np.array(GREY), (len(faces), 1))
    return np.asarray(found).round().astype(np.uint8)


def _near(mesh: Mesh, place: Intersection, reach: float, path: Any) -> Mesh:
    """The faces of a mesh that come into the square about a place."""
    plan = mesh.triangles[..., :2] + (mesh.origin - place.center)[:2]
    near = (plan.min(1) < reach).all(1) & (plan.max(1) > -reach).all(1)
    if not near.any():
        points = mesh.world.reshape(-1, 3)
        low, high = points.min(0), points.max(0)
        raise InspeError(
            f"{path}: nothing within {reach:g} m of {place.name} at "
            f"({place.center[0]:.0f}, {place.center[1]:.0f}): the mesh lies in x {low[0]:.0f} … "
            f"{high[0]:.0f}, y {low[1]:.0f} … {high[1]:.0f}; it must be in the map's coordinates"
        )
    if near.sum() > MOST_FACES:
        raise InspeError(
            f"{path}: {near.sum():,} triangles near {place.name}; reduce it to {MOST_FACES:,}"
        )
    shift = np.asarray(place.center, float) - mesh.origin
    moved = mesh.triangles[near] - shift.astype(np.float32)
    return Mesh(np.asarray(place.center, float), moved, mesh.colour[near])


class _FromAbove:
    """A mesh on square cells about a place: the cells and the heights [m] where upright lines
    through their middles meet ``triangles``, by cell and from below."""

    def __init__(self, mesh: Mesh, place: Intersection, reach: float) -> None:
        half = int(np.ceil(reach / CELL))
        self.corner, self.side = np.asarray(place.center, float)[:2] - half * CELL, 2 * half
        self.triangles = mesh.world
        self.cell, self.z = self._surfaces()

    def middle(self, cell: Int[np.ndarray, " N"]) -> Float[np.ndarray, "N 2"]:
        """The middles of cells by number."""
        return self.corner + (np.column_stack(np.divmod(cell, self.side)) + 0.5) * CELL

    def _surfaces(self) -> tuple[Int[np.ndarray, " N"], Float[np.ndarray, " N"]]:
        at = (self.triangles[..., :2] - self.corner) / CELL - 0.5
        first = np.clip(np.ceil(at.min(1)), 0, self.side).astype(int)
        count = np.clip(np.floor(at.max(1)), -1, self.side - 1).astype(int) + 1 - first
        number = np.where((count > 0).all(1), count.prod(1), 0)

        def within(part: slice) -> tuple[np.ndarray, np.ndarray]:
            """The cells whose middle a triangle covers, and its height there."""
            which, nth = _repeated(number[part])
            i = first[part][which, 0] + nth // np.maximum(count[part][which, 1], 1)
            j = first[part][which, 1] + nth % np.maximum(count[part][which, 1], 1)
            (ax, ay), (bx, by), (cx, cy) = (at[part][which, k].T for k in range(3))
            area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
            flat = np.abs(area) < 1e-12  # upright triangles
            area = np.where(flat, 1.0, area)
            v = ((i - ax) * (cy - ay) - (cx - ax) * (j - ay)) / area
            w = ((bx - ax) * (j - ay) - (i - ax) * (by - ay)) / area
            inside = ~flat & (v >= 0) & (w >= 0) & (v + w <= 1)  # on an edge, in both triangles
            za, zb, zc = (self.triangles[part][which, k, 2] for k in range(3))
            height = za + v * (zb - za) + w * (zc - za)
            return (i * self.side + j)[inside], height[inside]

        parts = np.searchsorted(number.cumsum(), np.arange(0, number.sum() + AT_ONCE, AT_ONCE))
        pairs = zip(parts, [*parts[1:], len(number)], strict=True)
        found = [within(slice(a, b)) for a, b in pairs if b > a]
        cell, z = (np.concatenate(part) for part in zip(*found, strict=True))
        order = np.lexsort([z, cell])
        return cell[order], z[order]

    def upright(self) -> tuple[Int[np.ndarray, " N"], Float[np.ndarray, " N"]]:
        """Points on the edges of steep triangles, at most half a cell apart: cells and heights [m].
        Lines through the middles of cells miss walls."""
        across = np.cross(*np.diff(self.triangles, axis=1).swapaxes(0, 1))
        steep = np.abs(across[:, 2]) < STEEP * np.linalg.norm(across, axis=1)
        ends = self.triangles[steep][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2, 3)
        parts = np.maximum(np.ceil(2 * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / CELL), 1)
        number = np.minimum(parts, 2 * self.side).astype(int) + 1
        which, nth = _repeated(number)
        share = (nth / (number[which] - 1))[:, None]
        points = ends[which, 0] * (1 - share) + ends[which, 1] * share
        # A wall on the line between two cells belongs to both.
        beside = 0.02 * np.array([[-1, -1, 0], [-1, 1, 0], [1, -1, 0], [1, 1, 0]])
        points = (points[:, None] + beside).reshape(-1, 3)
        at = np.floor((points[:, :2] - self.corner) / CELL).astype(int)
        inside = ((at >= 0) & (at < self.side)).all(1)
        return (at[:, 0] * self.side + at[:, 1])[inside], points[inside, 2]


def _repeated(number: Int[np.ndarray, " F"]) -> tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"]]:
    """Indices of row i repeated ``number[i]`` times, and the place of each among its own."""
    which = np.repeat(np.arange(len(number)), number)
    return which, np.arange(len(which)) - np.repeat(number.cumsum() - number, number)


def _ground(place: Intersection, seen: _FromAbove, path: Any) -> Float[np.ndarray, "G 3"]:
    """Points of the ground: in cells of the regions, the surface nearest to the median around."""
    regions = unary_union(list(place.regions.values()))
    shapely.prepare(regions)
    on = shapely.contains_xy(regions, *seen.middle(seen.cell).T)
    cell, z = seen.cell[on], seen.z[on]
    cells, lowest = np.unique(cell, return_index=True)
    area = len(cells) * CELL**2
    square = shapely.box(*seen.corner, *(seen.corner + seen.side * CELL))
    if len(cells) == 0 or area < COVERED * regions.intersection(square).area:
        raise InspeError(
            f"{path}: has ground for {area:.0f} m² of the regions of {place.name}; the mesh must "
            "have the roads, in the map's coordinates and z up (y up in glTF)"
        )
    image = np.full(seen.side**2, np.median(z[lowest]))
    image[cells] = z[lowest]
    level = ndimage.median_filter(image.reshape(seen.side, seen.side), int(AROUND / CELL)).ravel()
    off = np.abs(z - level[cell])
    nearest = np.lexsort([off, cell])[lowest]
    nearest = nearest[off[nearest] < LOW]  # a road user of a survey hides the road
    return np.column_stack([seen.middle(cell[nearest]), z[nearest]])


def _shapes(place: Intersection, seen: _FromAbove) -> Iterator[Shape]:
    cell, (upright, edges) = seen.cell, seen.upright()
    edges = edges - place.ground(seen.middle(upright))
    over = seen.z - place.ground(seen.middle(cell))
    count, high = seen.side**2, over > LOW
    wall = edges > LOW
    top, base, foot = np.full(count, -np.inf), np.full(count, np.inf), np.full(count, np.inf)
    at, level = np.r_[cell[high], upright[wall]], np.r_[over[high], edges[wall]]
    np.maximum.at(top, at, level)
    np.minimum.at(base, at, level)
    np.minimum.at(foot, upright, edges)
    # Beside cells with a surface, cells with upright faces alone are on the far side of a wall.
    square = (seen.side, seen.side)
    covered = np.zeros(count, bool)
    covered[cell[high]] = True
    near = ndimage.binary_dilation(covered.reshape(square), np.ones((3, 3))).ravel()
    there = (top > LOW) & (covered | ~near)
    stands = there & (np.minimum(foot, base) < STANDS)
    stands = ndimage.binary_fill_holes(stands.reshape(square)).ravel() & there
    base = np.where(stands, 0.0, base)
    touching, _ = ndimage.label(there.reshape(square), np.ones((3, 3)))
    large = np.bincount(touching.ravel())[touching.ravel()] >= SMALL
    cells = np.flatnonzero(there & large)
    base, top = base[cells], top[cells]
    alike = np.column_stack([np.searchsorted(LEVELS, end, "right") for end in (base, top)])
    kinds, label = np.unique(alike, axis=0, return_inverse=True)
    corner = seen.corner + np.column_stack(np.divmod(cells, seen.side)) * CELL
    squares = shapely.box(*corner.T, *(corner + CELL).T)
    for k in range(len(kinds)):
        own = label.ravel() == k
        # A single sheet, as of a sign from the side, is as thick as a cell.
        height = max(float(top[own].mean()), LOW)
        low = min(float(base[own].mean()), height - LOW)
        for part in shapely.get_parts(unary_union(squares[own])):
            yield Shape("solid", part, height, max(low, 0.0))
