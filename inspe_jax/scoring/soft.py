"""The three metrics read softly, tile by tile: what gradients are of.

The same measures as :func:`inspe_jax.scoring.reference.measure`, from the same margins. A soft
reading is certain beyond its width (:func:`inspe_jax.core.numerics.step`), so here too whole tiles
are told apart from most fields of view and most shadows, and nothing is left out. (Where there are
more levels than bits in a word, the vehicles that hide most are found for each slab of them, not
for all.)
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float, UInt

from inspe_jax.core.geometry import Prism
from inspe_jax.core.numerics import REACH, Groups, Softness, Width, leave_one_out
from inspe_jax.scoring import metrics
from inspe_jax.scoring.exact import VisibilityCounts, joined, summed_up
from inspe_jax.scoring.reference import (
    MetricValues,
    SensorArray,
    SensorSet,
    ignores_self_occlusion,
    sensor_array,
)
from inspe_jax.scoring.tiled_scene import TiledScene
from inspe_jax.sensing.rays import RayTable
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.in_view import soft_view
from inspe_jax.visibility.shadows import WON, may_shade, shadow_bounds, soft_sight
from inspe_jax.visibility.tiles import Tile, solid_in, unless_empty

SIGHTS = "sights"
"""Name of how often each sensor sees each voxel."""
FRAMES = 20
"""Frames that are gone through together: what a tile needs of them stays in a core's cache."""


def measure_softly(
    world: TiledScene,
    poses: Float[Array, "S 6"],
    crew: SensorSet,
    voxel: float,
    softness: Softness,
    *,
    occlusion_reference: str = "roi",
    visibility: str = "in_view",
) -> MetricValues:
    """The three metrics of poses about the scene's centre, in the paper's order.

    As :func:`~inspe_jax.scoring.reference.measure`, of a world whose shares have all tiles; its
    masks are not asked for, but found tile by tile. Differentiable in the poses, in reverse mode;
    not in the softness.
    """
    sensors = sensor_array(crew)
    options = dict(occlusion_reference=occlusion_reference, visibility=visibility)
    measured = read_softly(
        world.bucketed, sensors.filled(poses), sensors, voxel, softness, **options
    )
    return measured.of_scene(world.tiles.place, len(crew.failures))


@partial(jax.jit, static_argnames=("occlusion_reference", "visibility"))
def read_softly(
    world: TiledScene,
    poses: Float[Array, "S 6"],
    sensors: SensorArray,
    voxel: float | Array,
    softness: Softness,
    *,
    occlusion_reference: str,
    visibility: str,
) -> MetricValues:
    """:func:`measure_softly` of arrays that are filled up: of the tiles' columns, and with a row
    for each group of failures that there is room for."""
    softness = jax.lax.stop_gradient(softness)
    reliability = jnp.asarray(sensors.reliability, float)[:, None, None]
    watch = partial(
        _watch,
        sensors=poses[:, :3],
        width=softness.shadow,
        failures=sensors.failures,
        reference=occlusion_reference,
        visibility=visibility,
    )

    # Kept for the gradient, what every tile needs would be gigabytes; but for what would else have
    # to be found by going through all frames once more.
    @partial(jax.checkpoint, policy=jax.checkpoint_policies.save_only_these_names(SIGHTS))
    def look(tile: Tile) -> tuple[Array, Array, Array, VisibilityCounts]:
        f = _views(tile, poses, sensors, voxel / 2, softness)
        watched = joined([watch(tile, f, share.prisms) for share in world.shares])
        q = f
        if watched.sights is not None:
            q = f * checkpoint_name(watched.sights, SIGHTS).swapaxes(1, 2) / world.frame_count
        covered = leave_one_out(f, sensors.failures)
        resolved = leave_one_out(q * reliability, sensors.failures)
        return covered.sum(1), covered[0].sum(1), resolved, watched._replace(sights=None)

    tiles = world.tiles
    columns, by_level, resolved, watched = jax.lax.map(unless_empty(look), tiles.tile)
    columns = columns.swapaxes(0, 1).reshape(columns.shape[1], tiles.slabs, -1)
    by_level = by_level.reshape(tiles.slabs, len(tiles.tile.there) // tiles.slabs, -1)
    tile, column = jnp.divmod(world.column, tiles.tile.there.shape[1])
    return summed_up(
        world,
        columns.sum(1) / tiles.level_count,
        by_level.sum(1).reshape(-1),
        metrics.entropy_terms(resolved[tile, :, world.level, column].T, world.occupancy),
        watched._replace(seen=watched.seen.sum(0), original=watched.original.sum(0)),
    )


def _views(
    tile: Tile,
    poses: Float[Array, "S 6"],
    sensors: SensorArray,
    half: float | Array,
    softness: Softness,
) -> Float[Array, "S Z C"]:
    """How surely each sensor has each voxel of a tile in view."""

    def look(one: tuple[Array, RayTable, Array]) -> Array:
        kind, table, pose = one
        return soft_view(sensors.kinds, kind, table, half, softness, pose, tile)

    each = jnp.asarray(sensors.kind), jax.tree.map(jnp.asarray, sensors.table), poses
    return jax.lax.map(look, each)


def _watch(
    tile: Tile,
    f: Float[Array, "S Z C"],
    prisms: Prism,
    *,
    sensors: Float[Array, "S 3"],
    width: Width,
    failures: Groups | None,
    reference: str,
    visibility: str,
) -> VisibilityCounts:
    """Go through the frames, in one tile."""
    total, levels = len(prisms.top), f.shape[1]
    reach = 0.0 if width is None else REACH * width
    parts = -(-total // FRAMES)
    each = -(-total // parts)

    def in_parts(x: Array) -> Array:
        """(T, …) as (parts, each, …), padded with zeros: frames without prisms."""
        x = jnp.pad(x, [(0, parts * each - total)] + [(0, 0)] * (x.ndim - 1))
        return x.reshape(parts, each, *x.shape[1:])

    split = jax.tree.map(in_parts, (prisms, jnp.ones(total)))
    sighted, spare = visibility != "in_view", ignores_self_occlusion(reference, visibility)
    nobody = jnp.zeros(())

    def bits(words: UInt[Array, "..."]) -> Float[Array, "..."]:
        """(…) as (Z, …)."""
        z = jnp.arange(levels, dtype=words.dtype).reshape(-1, *[1] * words.ndim)
        return ((words[None] >> z) & words.dtype.type(1)).astype(float)

    there, inside = tile.there[None], solid_in(tile, prisms)
    # What is inside a vehicle is in sight for O, and not for IG.
    apart = spare and visibility == "line_of_sight"
    covered = leave_one_out(f, failures)
    whole = covered if reference == "covered" else jnp.ones_like(covered)

    @jax.checkpoint  # kept for the gradient, every frame's sight lines would not fit in memory
    def some(part: tuple[tuple[Prism, Array], Array]) -> tuple[Array, ...]:
        (prisms, real), inside = part
        solid, free = bits(inside), bits(there & ~inside)

        def clear(one: tuple[Array, Array]) -> list[Float[Array, "Z F C"]]:
            sensor, f = one

            @partial(jax.checkpoint, policy=jax.checkpoint_policies.save_only_these_names(WON))
            def shaded(sensor: Array) -> list[Array]:
                fixed = jax.lax.stop_gradient(sensor)
                cast = shadow_bounds(fixed, prisms, reach)
                marked = bitmask.marks(may_shade(fixed, cast, tile))
                at = sensor, prisms, marked, tile.columns, tile.heights, width
                found = soft_sight(*at, ignore_self_occlusion=(solid > 0) if spare else False)
                return [found, soft_sight(*at)] if apart else [found]

            nothing = jnp.zeros((levels, each, f.shape[1]), f.dtype)
            none = [nothing] * (2 if apart else 1)
            return jax.lax.cond((f > 0).any(), shaded, lambda _: none, sensor)

        clears, *lines = jax.lax.map(clear, (sensors, f))  # (S, Z, F, C)
        in_sight = lines[0] if apart else clears
        visible = leave_one_out(f[:, :, None] * clears, failures)
        counts = solid if reference == "targets" else free
        return (
            (visible * counts[None]).sum(1).sum(-1),
            (whole[:, :, None] * counts[None]).sum(1).sum(-1),
            ((visible[0] * free).sum(0) * real[:, None]).sum(0),
            (in_sight * real[None, None, :, None]).sum(2).swapaxes(1, 2) if sighted else nobody,
        )

    seen, original, columns, sights = jax.lax.map(some, (split, in_parts(inside)))
    seen, original = (x.swapaxes(0, 1).reshape(len(whole), -1)[:, :total] for x in (seen, original))
    return VisibilityCounts(seen, original, columns.sum(0), sights.sum(0) if sighted else None)
