"""A varifocal lens: read exactly and softly, searched, and kept in files and on the bill."""

import csv
from dataclasses import replace

import jax
import numpy as np
import pytest
from mounts import SIDEWALK, team
from worlds import TINY, double_precision, place_sensors, random_layout, world

import inspe_jax
from inspe_jax.core.arrays import from_center, pad_rows
from inspe_jax.core.errors import InspeError
from inspe_jax.core.numerics import Softness
from inspe_jax.placement import candidates
from inspe_jax.placement.candidate_table import Table
from inspe_jax.placement.methods.differences import differences
from inspe_jax.placement.problem import Problem
from inspe_jax.report.handover import bill_of_materials
from inspe_jax.scoring.driver import measure_tiles
from inspe_jax.scoring.exact import measure_exactly
from inspe_jax.scoring.numbers import Numbers
from inspe_jax.scoring.options import ScoreOptions
from inspe_jax.scoring.tiled_scene import tiled_scene_of
from inspe_jax.sensing.catalogue import spec_of, table_of
from inspe_jax.sensing.layout import layout_text, load_layout, save_layout
from inspe_jax.sensing.sensor_array import SensorSet, sensor_array

ZOOM = spec_of({"like": "paper-camera", "hfov_deg": [40, 120], "depth_m": 25}, "zoom", "here")
NAMES = ("coverage", "occlusion", "information_gain", "detectability", "localisation")
OPTIONS = ScoreOptions.of(occlusion_reference="roi", visibility="past_others", names=NAMES)


def test_its_range_is_that_of_the_field_of_view():
    low, high = (ZOOM.with_lens(lens) for lens in (-9.0, 9.0))
    views = [np.degrees(spec.field_of_view[0]) for spec in (high, low)]
    np.testing.assert_allclose(views, [40, 120])
    assert ZOOM.with_lens(0.1).lens == pytest.approx(0.1)
    assert low.lens == pytest.approx(ZOOM.lens_limits[0])
    assert spec_of(table_of(low), "zoom", "here") == ZOOM
    odd = replace(ZOOM, focal=700.0, focal_range=(500.0, 1234.5678901))
    assert spec_of(table_of(odd), "zoom", "here") == odd.with_lens(0.0)
    with pytest.raises(InspeError, match="must ascend about the focal length, but is 500 to 900"):
        replace(ZOOM, focal=3000.0, focal_range=(500.0, 900.0))
    assert replace(ZOOM, focal_range=None).with_lens(0.3).lens == 0.0


@pytest.mark.parametrize("lens", [-0.75, 0.4])
def test_a_score_through_a_lens_is_that_of_a_camera_of_its_focal_length(scene, lens):
    """Of every metric, also where tangents span more than half a turn would, in radians."""
    layout = random_layout(scene, [ZOOM, ZOOM], 2, heights=(3.0, 6.0))
    set_to = [replace(one, spec=one.spec.with_lens(lens)) for one in layout.sensors]
    poses = from_center(scene.voxels.center, np.asarray(layout.poses))
    through = np.column_stack([poses, [lens, lens]])
    tiled, voxel = tiled_scene_of(scene), scene.voxels.size
    found = measure_exactly(tiled, through, SensorSet.of(layout), voxel, OPTIONS)
    other = SensorSet.of(replace(layout, sensors=tuple(set_to)))
    expected = measure_exactly(tiled, poses, other, voxel, OPTIONS)
    usual = measure_exactly(tiled, poses, SensorSet.of(layout), voxel, OPTIONS)
    for name in NAMES:
        assert found.values[name][0] == pytest.approx(expected.values[name][0], abs=1e-4)
    assert abs(expected.values["coverage"][0] - usual.values["coverage"][0]) > 0.01


@pytest.mark.parametrize("rays", ["density", pytest.param("exact", marks=pytest.mark.slow)])
def test_its_slope_is_that_of_differences(rays):
    """Of rays as they are, also through what a detector gets."""
    with double_precision():
        scene = world(**TINY)
        layout = place_sensors((ZOOM, [8.0, 6.0, 5.0, 0.0, -0.4, -2.4]))
        sensors = sensor_array(SensorSet.of(layout))
        tiled = tiled_scene_of(scene, whole=True, masks=False).bucketed
        poses = from_center(scene.voxels.center, np.asarray(layout.poses))
        rows = pad_rows(np.column_stack([poses, [0.2]]), len(sensors.kind))
        reading = Numbers(Softness(0.5, 0.5, rays))
        given = dict(occlusion_reference="roi", visibility="in_view")
        names = ("coverage", "detectability") if rays == "exact" else ("coverage",)
        some = ScoreOptions.of(**given, names=names)

        @jax.jit
        @jax.value_and_grad
        def score(rows):
            found = measure_tiles(reading, tiled, rows, sensors, scene.voxels.size, options=some)
            return sum(value[0] for value in found.values.values())

        slope, step = score(rows)[1], np.zeros_like(rows)
        step[0, 6] = 1e-6
        expected = (score(rows + step)[0] - score(rows - step)[0]) / 2e-6
        assert float(slope[0, 6]) == pytest.approx(float(expected), rel=1e-5)
        assert abs(expected) > 1e-3


def test_a_search_sets_it_and_its_result_is_kept(scene, tmp_path):
    """Also by differences of the hard score, whose slope is the soft one's."""
    layout = team(scene, second=ZOOM)
    result = inspe_jax.optimise(scene, layout, method="adam", evaluations=25, seed=0)
    (found,) = (one.spec for one in result.layout.sensors if one.spec.name == "zoom")
    assert abs(found.lens) > 0.01
    assert result.objective == pytest.approx(inspe_jax.evaluate(scene, result.layout).surrogate)
    save_layout(result.layout, tmp_path / "found.yaml")
    again = load_layout(tmp_path / "found.yaml")
    assert again.sensors[1].spec.focal == pytest.approx(found.focal)
    problem = Problem(scene, layout)
    x, _ = problem.space.start(again)
    assert problem.space.layout(x).sensors[1].spec.lens == pytest.approx(found.lens)
    poses = candidates.poses(problem.space, x[None])[0]
    on = problem.take(problem.draw(np.random.default_rng(0), 400, 5))
    hard, soft = (
        of(poses, on, 0.5)[1] for of in (lambda *at: differences(problem, *at), problem.slope)
    )
    assert hard.shape == soft.shape == (5, 7)
    assert hard[1, 6] * soft[1, 6] > 0


@pytest.mark.slow
def test_slopes_of_a_set_lens_are_those_of_a_camera_of_its_focal_length(scene):
    """Also where no search could place it."""
    layout = place_sensors((ZOOM.with_lens(0.5), [9.0, 9.0, 5.0, 0.0, -0.4, -2.4]))
    fixed = replace(layout.sensors[0].spec, focal_range=None)
    given = dict(samples=1, seed=0)
    ours = inspe_jax.tolerance(scene, layout, **given)
    theirs = inspe_jax.tolerance(scene, place_sensors((fixed, layout.poses[0].tolist())), **given)
    assert ours.score == pytest.approx(theirs.score)
    assert ours.slopes[0].pitch == pytest.approx(theirs.slopes[0].pitch, rel=1e-3, abs=1e-6)


def test_candidates_of_cameras_without_a_lens_are_their_own(scene):
    usual = replace(ZOOM, focal_range=None)
    for specs in ((ZOOM, usual), (usual, ZOOM)):
        both = place_sensors(*((spec, [*SIDEWALK, 5.0, 0.0, -0.4, 0.0]) for spec in specs))
        table = Table.of(Problem(scene, both), np.random.default_rng(0), 96, 1)
        zooms = [bool(table.kind_of(s).lens.any()) for s in range(2)]
        assert zooms == [spec is ZOOM for spec in specs]


def test_devices_of_one_lens_are_a_row_of_the_bill():
    specs = [ZOOM.with_lens(0.2), ZOOM.with_lens(0.2), ZOOM]
    layout = place_sensors(*((spec, [5.0 * k, 12.0, 4.0, 0, 0, 0]) for k, spec in enumerate(specs)))
    rows = [*csv.DictReader(bill_of_materials(layout, {"zoom": 900.0}).splitlines())]
    assert [(row["device"], row["hfov_deg"]) for row in rows] == [
        ("zoom", "66.1"),
        ("zoom", "76.9"),
    ]
    assert [row["total_usd"] for row in rows] == ["1800.00", "900.00"]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (dict(hfov_deg=[100, 40]), "hfov_deg: must ascend, but 40 follows 100"),
        (dict(hfov_deg=[40, 230]), r"hfov_deg\[1\]: .*less than or equal to 220, got 230"),
        (dict(hfov_deg=[40, 200]), "hfov_deg: only a 'lens: fisheye' sees 180° or more"),
        (dict(hfov_deg=[40, 100], focal_px=500), "give either hfov_deg or focal_px"),
    ],
)
def test_each_bad_range_gets_its_message(keys, message):
    with pytest.raises(InspeError, match=message):
        spec_of(
            table_of(replace(ZOOM, focal_range=None)) | {"focal_px": None} | keys, "zoom", "here"
        )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [("hfov_deg: 7", "hfov_deg: 17", r"sensors\[0\].hfov_deg: 17.* is not between 40 and 120"),
     ("device: zoom", "device: paper-camera", "'paper-camera' has no varifocal lens")],
)  # fmt: skip
def test_a_file_sets_it_within_its_range(tmp_path, old, new, message):
    layout = place_sensors((ZOOM, [0.0, 12.0, 4.0, 0, 0, 0]))
    text = layout_text(layout)
    assert old in text
    (tmp_path / "bad.yaml").write_text(text.replace(old, new))
    with pytest.raises(InspeError, match=message):
        load_layout(tmp_path / "bad.yaml")
