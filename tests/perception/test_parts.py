"""What detectors are made of, against the same written otherwise."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from shapely.affinity import translate
from shapely.geometry import box

from inspe_jax.core.geometry import pose_matrix
from inspe_jax.dataset.loading import PillarGrid, Pillars, Targets, on_picture
from inspe_jax.perception import encoders, head, layers
from inspe_jax.perception import fusion as fusions
from inspe_jax.perception.inputs import BevGrid, Inputs
from inspe_jax.simulation.frame import KINDS, RoadUserBox
from inspe_jax.simulation.projection import corners

GRID = BevGrid(half=12.8)


def noise(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


POSE = pose_matrix([-20, 5, 7, 0.1, -0.4, -0.3]).astype(np.float32)
INTRINSIC = np.array([[40.0, 0, 30], [0, 42, 22], [0, 0, 1]], np.float32)


def three_cameras(high: int, wide: int) -> Inputs:
    """Pictures of two units' cameras at :data:`POSE`, and padding."""
    return Inputs(
        pillars=None,
        pixels=np.zeros((1, 3, high, wide, 3), np.uint8),
        intrinsic=np.stack([INTRINSIC] * 3)[None],
        pose=np.stack([POSE] * 3)[None],
        unit=np.array([[0, 1, -1]], np.int32),
        present=np.ones((1, 2), bool),
    )


def made(part):
    """A part with weights, in one program instead of one for each shape."""
    return eqx.filter_jit(part)(jax.random.key(3))


def test_depthwise_norm_and_attention():
    x = noise(2, 9, 8, 16)
    depthwise, norm = made(lambda key: (layers.Depthwise(16, key, stride=2), layers.Norm(16)))
    query, keys = noise(3, 2, 4, seed=1), noise(5, 2, 4, seed=2)
    mask = np.array([True, False, True, True, False])

    @jax.jit
    def both(x, query, keys, mask):
        weight = depthwise.weight[:, :, None]
        # "SAME" of a stride begins at another cell where the side is even.
        padded = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
        theirs = lax.conv_general_dilated(
            padded, weight, (2, 2), "VALID",
            dimension_numbers=("NHWC", "HWIO", "NHWC"), feature_group_count=16,
        )  # fmt: skip
        return depthwise(x), theirs[:, :5, :4], norm(x), layers.attend(query, keys, keys, mask)

    ours, theirs, normal, told = map(np.asarray, both(x, query, keys, mask))
    np.testing.assert_allclose(ours, theirs, atol=1e-5)
    groups = normal.reshape(2, 9, 8, 8, 2)
    np.testing.assert_allclose(groups.mean((1, 2, 4)), 0, atol=1e-5)
    np.testing.assert_allclose(groups.std((1, 2, 4)), 1, atol=1e-4)
    scores = np.einsum("qhc,khc->hqk", query, keys[mask]) / 2
    weights = np.exp(scores) / np.exp(scores).sum(-1, keepdims=True)
    np.testing.assert_allclose(told, np.einsum("hqk,khc->qhc", weights, keys[mask]), atol=1e-5)


def apart_and_back(x):
    near, far = fusions.to_windows(x, 4), fusions.to_windows(x, 4, sparse=True)
    back = fusions.from_windows(near, 8, 12), fusions.from_windows(far, 8, 12, sparse=True)
    return near, far, *back


def test_windows_and_grids_are_cells_of_the_map():
    x = np.arange(2 * 8 * 12).reshape(2, 8, 12, 1)
    near, far, *back = map(np.asarray, jax.jit(apart_and_back)(x))
    np.testing.assert_array_equal(near[1, 4, :, 0], x[1, 4:8, 4:8, 0].ravel())
    np.testing.assert_array_equal(far[1, 4, :, 0], x[1, 1::2, 1::3, 0].ravel())
    for again in back:
        np.testing.assert_array_equal(again, x)
    number = fusions.offsets(3)
    assert number[0, 4] == number[4, 8] != number[8, 4]
    assert len(np.unique(number)) == 25


def test_a_pillar_is_the_maximum_over_its_points_and_padding_changes_nothing():
    grid = PillarGrid(half=3.2, cell=0.8, most_points=3, most_pillars=4)
    points, counts = noise(1, 2, 4, 3, 4), np.array([[[3, 2, 0, 0], [1, 0, 0, 0]]], np.int32)
    cells = np.array([[[[0, 5], [7, 2], [0, 0], [0, 0]], [[0, 5], [0, 0], [0, 0], [0, 0]]]])
    there = np.arange(3) < counts[..., None]
    points = np.where(there[..., None], points, 0)
    encoder = made(lambda key: encoders.PillarEncoder(grid, 8, key))
    found = np.asarray(eqx.filter_jit(encoder)(Pillars(points, counts, cells.astype(np.int32))))
    assert found.shape == (1, 2, 8, 8, 8)
    taken = np.zeros((2, 8, 8), bool)
    taken[0, [0, 7], [5, 2]] = taken[1, 0, 5] = True
    assert (found[0][~taken] == 0).all()
    assert found[0][taken].any(-1).all()
    inner, outer = jax.tree.map(np.asarray, (encoder.network.inner, encoder.network.outer))
    mean, middle = points[0, 0, 1, :2, :3].mean(0), (np.array([7, 2]) + 0.5) * 0.8 - 3.2
    rows = [
        [*(p[:2] / 3.2), p[2] / 3, p[3], *((p[:2] - mean[:2]) / 0.4), (p[2] - mean[2]) / 3]
        + [*((p[:2] - middle) / 0.4)]
        for p in points[0, 0, 1, :2]
    ]
    hidden = np.maximum(np.array(rows) @ inner.weight + inner.bias, 0)
    told = np.maximum(hidden @ outer.weight + outer.bias, 0).max(0)
    np.testing.assert_allclose(found[0, 0, 7, 2], told, rtol=1e-4, atol=1e-5)


def test_every_weight_of_a_resnet_learns():
    encoder = made(lambda key: encoders.ImageEncoder(encoders.Bottleneck, 16, key))
    pixels = np.random.default_rng(0).integers(0, 256, (1, 48, 64, 3)).astype(np.uint8)
    weights = noise(1, 12, 16, 16)
    slopes = eqx.filter_jit(eqx.filter_grad(lambda encoder: (encoder(pixels) * weights).sum()))
    assert all(np.asarray(leaf).any() for leaf in jax.tree.leaves(slopes(encoder)))


def test_lifted_features_fall_into_the_cell_that_their_pixel_and_height_show():
    """The other way round: the point in a cell of the map, projected, is the pixel it came from."""
    grid, high, wide = BevGrid(half=51.2), 48, 64
    given = encoders.Bottleneck, grid, 2, 8, jax.random.key(0)
    splat = eqx.filter_eval_shape(encoders.LiftSplat, *given)
    inputs = three_cameras(high, wide)
    cells = np.asarray(jax.jit(lambda i: splat._cells(i, (high, wide), (6, 8)))(inputs))[0]
    nowhere, side = 2 * grid.side**2, grid.side
    assert (cells[2] == nowhere).all()  # a camera that is not there
    some = cells[0] != nowhere
    np.testing.assert_array_equal(cells[1][some], cells[0][some] + side**2)
    row, column, h = np.nonzero(some)
    assert len(row) > 80
    assert set(h) == set(range(len(encoders.HEIGHTS)))
    at = np.column_stack([(column + 0.5) * 8, (row + 0.5) * 8])
    body = np.column_stack([np.ones(len(at)), -(at[:, 0] - 30) / 40, -(at[:, 1] - 22) / 42])
    ray = body @ POSE[:3, :3].T
    depth = (encoders.HEIGHTS[h] - POSE[2, 3]) / ray[:, 2]
    assert (depth > 0).all()
    world = ray * depth[:, None] + POSE[:3, 3]
    np.testing.assert_allclose(on_picture(world, POSE, INTRINSIC)[:, :2], at, atol=1e-2)
    expected = np.floor((world[:, :2] + grid.half) / grid.cell).astype(int)
    wrong = cells[0][some] != expected[:, 0] * side + expected[:, 1]
    edge = (np.abs((world[:, :2] + grid.half) / grid.cell % 1 - 0.5) > 0.499).any(1)
    assert not (wrong & ~edge).any()
    # All that fall into the map are there: the rest is at the sky, behind, or beyond.
    rows, columns = np.mgrid[:6, :8] * 8 + 4
    body = np.stack([np.ones((6, 8)), -(columns - 30) / 40, -(rows - 22) / 42], -1)
    ray = body @ POSE[:3, :3].T
    ahead = ray[..., 2] < 0
    point = ray / np.where(ahead, -ray[..., 2], 1)[..., None] * (POSE[2, 3] - 1.0) + POSE[:3, 3]
    within = ahead & (np.abs(point[..., :2]) < grid.half).all(-1)
    assert 10 < within.sum() < 48
    np.testing.assert_array_equal(some[..., 6], within)  # 1 m


def test_a_cell_of_the_map_has_the_mean_of_what_falls_into_it():
    grid = BevGrid(half=12.8)
    splat = made(lambda key: encoders.LiftSplat(encoders.Bottleneck, grid, 1, 8, key))
    chance, features = np.abs(noise(2, 3, 4, 5)), noise(2, 3, 4, 8, seed=1)
    cell = np.random.default_rng(2).integers(0, grid.side**2 + 40, (2, 3, 4, 5))
    cell = np.where(cell < grid.side**2, cell % 7, grid.side**2)  # some are outside
    maps = np.asarray(jax.jit(lambda *of: splat._splat(*of, 1))(chance, features, cell))
    assert maps.shape == (grid.side**2, 8)
    for k in range(7):
        there = np.where(cell == k, chance, 0).sum(-1)
        mean = (there[..., None] * features).sum((0, 1, 2)) / (there.sum() + encoders.EMPTY_WEIGHT)
        np.testing.assert_allclose(maps[k], mean, rtol=1e-4, atol=1e-5)
    assert not maps[7:].any()


TYPES = (0, 0, 1)


@pytest.mark.parametrize("name", ["Mean", "AttFuse", "DiscoNet", "V2VNet", "V2XViT", "HMViT"])
def test_fusion_heeds_who_is_present_and_not_the_order(name, monkeypatch):
    """What an absent agent has changes nothing; two of one modality can be exchanged; and one
    agent alone keeps its map where nothing but weights of agents is learnt. Every weight learns."""
    monkeypatch.setattr(fusions, "V2X_LAYERS", 1)  # the others are the same
    fusion = made(lambda key: getattr(fusions, name)(16, TYPES, key))
    x, other = noise(2, 3, 16, 16, 16), noise(2, 3, 16, 16, 16, seed=1)
    present = np.array([[True, True, True], [True, False, False]])
    mixed = np.where(present[..., None, None, None], x, other)

    @eqx.filter_jit
    @partial(eqx.filter_grad, has_aux=True)
    def slopes(fusion, x, present):
        found = fusion(x, present)
        return (found * other[:, 0]).sum(), found

    def fuse(x, present):
        return np.asarray(slopes(fusion, x, present)[1])

    learnt, found = slopes(fusion, x, present)
    found = np.asarray(found)
    assert all(np.asarray(leaf).any() for leaf in jax.tree.leaves(learnt))
    np.testing.assert_allclose(fuse(mixed, present), found, atol=1e-5)
    np.testing.assert_allclose(fuse(x[:, [1, 0, 2]], present[:, [1, 0, 2]]), found, atol=1e-4)
    assert not np.allclose(fuse(other, present), found, atol=0.01)
    if name in ("Mean", "AttFuse", "DiscoNet"):
        np.testing.assert_allclose(found[1], x[1, 0], atol=1e-6)
    else:
        assert not np.allclose(found[1], x[1, 0], atol=0.01)


def softmax(scores: np.ndarray) -> np.ndarray:
    found = np.exp(scores - scores.max())
    return found / found.sum()


def test_agents_attend_by_the_modalities_of_both():
    """One receiver's cell after another; relations and messages are of receiver and sender."""
    attention = made(lambda key: fusions.HeterogeneousAttention(8, TYPES, 2, key))
    x, present = noise(1, 3, 2, 4, 8), np.array([[True, True, False]])
    found = np.asarray(eqx.filter_jit(lambda x: attention(x, present))(x))
    w = jax.tree.map(np.asarray, attention)
    for i, m, t in ((0, 0, 1), (1, 1, 3), (2, 1, 0)):
        a, told = TYPES[i], []
        for h in range(2):
            part = slice(4 * h, 4 * h + 4)
            query = (x[0, i, m, t] @ w.queries[a])[part]
            scores, values = [], []
            for j, s in ((j, s) for j in (0, 1) for s in range(4)):
                b, sent = TYPES[j], x[0, j, m, s]
                key = (sent @ w.keys[b])[part]
                scores.append(query @ w.relations[a, b, h] @ key / 2)
                values.append((sent @ w.values[b])[part] @ w.messages[a, b, h])
            told.append(softmax(np.array(scores)) @ np.array(values))
        expected = np.concatenate(told) @ w.outputs[a]
        np.testing.assert_allclose(found[0, i, m, t], expected, rtol=1e-3, atol=1e-4)


def test_a_window_attends_with_a_bias_by_the_offset_of_its_cells():
    windows = made(lambda key: fusions.WindowAttention(8, 2, 2, key))
    bias, x = noise(2, 9, seed=1), noise(1, 4, 4, 8)
    windows = eqx.tree_at(lambda it: it.bias, windows, jnp.asarray(bias))
    found = np.asarray(eqx.filter_jit(windows)(x))
    w = jax.tree.map(np.asarray, windows)
    cells = [(2, 0), (2, 1), (3, 0), (3, 1)]  # one window
    rows = {p: np.split(x[0][p] @ w.project.weight, 3) for p in cells}
    for p in cells:
        told = []
        for h in range(2):
            part = slice(4 * h, 4 * h + 4)
            query = rows[p][0][part]
            keys, values = (np.array([rows[q][n][part] for q in cells]) for n in (1, 2))
            apart = [bias[h, 3 * (p[0] - q[0] + 1) + p[1] - q[1] + 1] for q in cells]
            told.append(softmax(keys @ query / 2 + np.array(apart)) @ values)
        expected = np.concatenate(told) @ w.output.weight + w.output.bias
        np.testing.assert_allclose(found[0][p], expected, rtol=1e-3, atol=1e-4)


def test_v2vnet_takes_in_the_mean_message_of_the_others():
    """On maps of one cell only the middle of a convolution counts."""
    fusion = made(lambda key: fusions.V2VNet(4, TYPES, key))
    x, present = noise(1, 3, 1, 1, 4), np.array([[True, True, False]])
    found = np.asarray(eqx.filter_jit(lambda x: fusion(x, present))(x))[0, 0, 0]
    w = jax.tree.map(np.asarray, fusion)

    def conv(of, row):
        return row @ of.weight[1, 1] + of.bias

    def sigmoid(row):
        return 1 / (1 + np.exp(-row))

    state = list(x[0, :2, 0, 0])
    for _ in range(2):
        after = []
        for own, other in (state, state[::-1]):
            message = np.maximum(conv(w.receiver, own) + conv(w.sender, other), 0)
            gates = sigmoid(conv(w.unit.gates, np.concatenate([message, own])))
            update, reset = gates[:4], gates[4:]
            candidate = np.tanh(conv(w.unit.candidate, np.concatenate([message, reset * own])))
            after.append((1 - update) * candidate + update * own)
        state = after
    np.testing.assert_allclose(found, np.mean(state, 0), rtol=1e-3, atol=1e-4)


def test_disconet_weighs_senders_for_each_cell():
    fusion = made(lambda key: fusions.DiscoNet(8, TYPES, key))
    x, present = noise(1, 3, 1, 2, 8), np.array([[True, False, True]])
    found = np.asarray(eqx.filter_jit(lambda x: fusion(x, present))(x))[0, 0]
    w, there = jax.tree.map(np.asarray, fusion), (0, 2)
    for c in range(2):
        own = []
        for i in there:
            receiver = x[0, i, 0, c] @ w.receiver.weight + w.receiver.bias
            pairs = np.maximum(receiver + x[0, there, 0, c] @ w.sender.weight, 0)
            hidden = np.maximum(pairs @ w.edge.inner.weight + w.edge.inner.bias, 0)
            scores = (hidden @ w.edge.outer.weight + w.edge.outer.bias)[:, 0]
            own.append(softmax(scores) @ x[0, there, 0, c])
        np.testing.assert_allclose(found[c], np.mean(own, 0), rtol=1e-3, atol=1e-4)


def road_users() -> Targets:
    """Two frames: of four kinds, well apart, one outside the grid; and of one."""
    rng = np.random.default_rng(5)
    boxes, kind = np.zeros((2, 6, 9), np.float32), np.zeros((2, 6), np.int32)
    boxes[0, :5, :2] = [[-9, -7], [3, 8], [8, -8.3], [-6, 6.1], [20, 0]]
    boxes[1, 0, :2] = [0.4, 12.7]
    boxes[..., 3:6] = np.exp(rng.uniform(-0.5, 2, (2, 6, 3)))
    boxes[..., 2], boxes[..., 6] = rng.uniform(0, 2, (2, 6)), rng.uniform(-3, 3, (2, 6))
    kind[0, :4] = range(4)
    mask = np.zeros((2, 6), bool)
    mask[0, :5] = mask[1, 0] = True
    return Targets(boxes, kind, kind, np.zeros((2, 6, 0), np.int32), np.zeros((2, 6, 0)), mask)


def test_sizes_are_numbers_whatever_the_head_tells():
    values = np.full((1, GRID.side, GRID.side, 8), 1e4, np.float32)
    values[..., 3] = -1e4
    found = head.HeadOutput(np.zeros((1, GRID.side, GRID.side, len(KINDS)), np.float32), values)
    sizes = np.asarray(jax.jit(lambda found: head.peaks(found, GRID))(found).boxes[..., 3:6])
    np.testing.assert_allclose(sizes[..., 0], np.exp(-head.LARGEST_LOG), rtol=1e-5)
    np.testing.assert_allclose(sizes[..., 1:], np.exp(head.LARGEST_LOG), rtol=1e-5)


def test_what_the_head_is_to_tell_is_read_back_as_the_boxes():
    targets = road_users()

    @jax.jit
    def around(targets):
        aim, values = head.aims(targets, GRID), jnp.zeros((2, GRID.side, GRID.side, 8))
        own = jnp.where(aim.mask[..., None], aim.values, 0.0)
        values = values.at[jnp.arange(2)[:, None], aim.row, aim.column].add(own)
        heat = jnp.clip(aim.heat, 1e-6, 1 - 1e-6)
        found = head.HeadOutput(jnp.log(heat / (1 - heat)), values)
        off = head.HeadOutput(-found.heat, values + 1)
        return aim, head.peaks(found, GRID), head.loss(found, aim), head.loss(off, aim)

    aim, found, right, wrong = jax.tree.map(np.asarray, around(targets))
    inside = targets.mask & (np.abs(targets.boxes[..., :2]) < GRID.half).all(-1)
    np.testing.assert_array_equal(aim.mask, inside)
    assert (aim.heat == 1).sum() == inside.sum() == 5
    assert aim.heat.min() >= 0
    for b in range(2):
        top = found.score[b] > 0.99
        assert top.sum() == inside[b].sum()
        order = np.lexsort(found.boxes[b, top, :2].T)
        expected = targets.boxes[b, inside[b]]
        ours = np.lexsort(expected[:, :2].T)
        np.testing.assert_allclose(found.boxes[b, top][order], expected[ours], atol=1e-4)
        kinds = targets.kind[b, inside[b]][ours]
        np.testing.assert_array_equal(found.kind[b, top][order], kinds)
    assert right[1] == 0
    assert wrong[1] == pytest.approx(0.5 * 8, rel=1e-5)
    assert right[0] < 0.5 < wrong[0]
    assert len(KINDS) == aim.heat.shape[-1]


def test_a_road_user_that_no_sensor_sees_gives_no_loss_out_to_its_radius():
    returns, pixels = np.ones((2, 2, 6, 1), np.float32)
    returns[0, 1], pixels[0, :3, 0] = 0, (0.3, -1, 0)  # -1: the set does not say
    targets = road_users()._replace(returns=returns, pixels=pixels)
    found = head.HeadOutput(*(noise(2, GRID.side, GRID.side, count) for count in (4, 8)))

    @jax.jit
    def slopes(counted):
        aim = head.aims(targets, GRID, counted)
        slope = jax.grad(lambda found: sum(head.loss(found, aim)))(found)
        return aim.row, aim.column, abs(slope.heat), abs(slope.values)

    batch, (down, across) = np.arange(2)[:, None], np.mgrid[-2:3, -2:3].reshape(2, 1, 1, -1)
    inside = targets.mask & (np.abs(targets.boxes[..., :2]) < GRID.half).all(-1)
    for sensors, unseen in (
        (["lidar"], [[0, 1]]),
        (["camera"], [[0, 2]]),
        (["lidar", "camera"], []),
    ):
        counted = targets.seen_by(sensors)
        assert np.argwhere(~counted).tolist() == unseen
        row, column, heat, values = map(np.asarray, slopes(counted))
        cells = (np.clip(at[..., None] + by, 0, GRID.side - 1)
                 for at, by in ((row, down), (column, across)))  # fmt: skip
        near = heat[(batch[..., None], *cells, targets.kind[..., None])].max(-1)
        for slope in (near, values[batch, row, column].sum(-1)):
            np.testing.assert_array_equal(slope[inside] > 1e-9, counted[inside])


def test_the_radius_of_a_gaussian_keeps_boxes_overlapping():
    length, width = np.array([30.0, 12.0, 25.0]), np.array([8.0, 10.0, 20.0])
    found = np.asarray(jax.jit(head.radius)(np.array([*length, 0.8]), np.array([*width, 0.8])))
    assert found[-1] == head.LEAST_RADIUS
    for r, a, b in zip(found[:-1], length, width, strict=True):
        here = box(0, 0, a, b)
        there = translate(here, r, r)
        overlap = here.intersection(there).area / here.union(there).area
        assert overlap == pytest.approx(head.OVERLAP, rel=1e-4)


def test_heat_on_pictures_is_where_they_show_road_users():
    """Beside corners that are projected one by one."""
    high, wide, cells = 48, 64, (12, 16)
    boxes = np.zeros((1, 4, 9), np.float32)
    boxes[0, :, :7] = [
        [-8, 5, 0.8, 4.5, 1.9, 1.6, 0.4],
        [-11, 9, 0.9, 0.6, 0.6, 1.8, 0],
        [-8, 5, 0.8, 4.5, 1.9, 1.6, 0.4],  # not a road user
        [-30, 5, 0.8, 4.5, 1.9, 1.6, 0],  # behind the camera
    ]
    pixels = np.full((1, 4, 3), 100, np.float32)
    pixels[0, 1, 1] = 3  # hidden from the second camera
    kinds, mask = np.array([[0, 3, 0, 0]], np.int32), np.array([[True, True, False, True]])
    targets = Targets(boxes, kinds, kinds, np.zeros((1, 4, 0), np.int32), pixels, mask)
    inputs = three_cameras(high, wide)
    aims_of = jax.jit(lambda targets: head.perspective_aims(inputs, targets, cells))
    aim, shown = (np.asarray(x) for x in aims_of(targets))
    loss_of = jax.jit(lambda heat: head.focal_loss(heat, aim, shown))
    assert shown.tolist() == [[True, True, False, False], [True, False, False, False], [False] * 4]
    assert not aim[2].any()
    assert not aim[1, ..., 3].any()
    assert not aim[..., 1:3].any()
    for b, kind in ((0, 0), (1, 3)):
        x = boxes[0, b]
        own = RoadUserBox(0, KINDS[kind], "", x[:3], float(x[6]), x[3:6], np.zeros(3))
        at = on_picture(corners([own])[0], POSE, INTRINSIC)[:, :2] / 4
        middle = (at.min(0) + at.max(0)) / 2
        peak = np.unravel_index(aim[0, ..., kind].argmax(), cells)
        assert peak == tuple(np.floor(middle[::-1]).astype(int))
        assert aim[0, ..., kind].max() == 1
        spread = np.maximum((at.max(0) - at.min(0)) / 4, 0.5)
        row = aim[0, int(middle[1]), :, kind]
        off = np.arange(16) - np.floor(middle[0])
        np.testing.assert_allclose(row, np.exp(-0.5 * (off / spread[0]) ** 2), atol=1e-5)
    np.testing.assert_array_equal(aim[0, ..., 0], aim[1, ..., 0])
    unknown = aims_of(targets._replace(pixels=np.full_like(pixels, -1)))
    np.testing.assert_array_equal(unknown[1][1], shown[0])  # all in the picture are taken
    right = np.where(aim == 1, 20.0, -20.0).astype(np.float32)
    assert float(loss_of(right)) < 1e-3
    assert float(loss_of(-right)) > 10
