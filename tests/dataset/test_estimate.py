"""What a data set would hold and take, compared with what it then holds and takes."""

import sys
from collections import Counter

import made_up
import pytest
from opv2v_validator import check_set

from inspe_jax.core.files import prepare_folder
from inspe_jax.dataset import chunk, statistics
from inspe_jax.dataset.estimate import Sample, estimate
from inspe_jax.dataset.generate import DatasetWriter
from inspe_jax.dataset.plan import make_generation
from inspe_jax.jobs.sources import scene_of
from inspe_jax.sensing.lidar_returns import ATTENUATION
from inspe_jax.simulation.embedded.road_users import parked_vehicles

pytest.importorskip("embreex", reason="no wheels of Embree for this platform")

STUDY = dict(
    scenes=[{"built_in": "four_way", "tags": {"kind": "crossing"}}],
    layouts=["Cam-d1/L-d1", "L-c"],
    settings=dict(radius=15, voxel=2, density=8, seconds=0.2, seed=[0, 1]),
    image_size=[80, 60],
    splits=dict(train=1, test=1),
)
STREET = dict(statics="street", radius=30)


def test_workers_share_the_frames_and_open_a_recorder_each(tmp_path, monkeypatch):
    """Four scenarios of 40 frames, in chunks of 10: with 2 workers each is opened twice."""
    settings = STUDY["settings"] | dict(seconds=4)
    generation = make_generation(STUDY | dict(settings=settings), tmp_path)
    module = sys.modules[estimate.__module__]
    monkeypatch.setattr(module, "_sample", lambda *_: Sample(setup=6.0, frame=0.5, size=1000))
    monkeypatch.setattr(module.time, "perf_counter", lambda: 0.0)
    for workers, opened in ((1, 1), (2, 2), (9, 4)):
        found = estimate(generation, workers=workers)
        assert found.seconds == pytest.approx(4 * (40 * 0.5 + 6.0 * opened) / workers)
        assert found.size == 4 * 40 * 1000
    untried = estimate(generation, "carla")  # it needs a server
    assert (untried.size, untried.seconds) == (None, None)


def test_sizes_and_counts_are_those_of_the_set(tmp_path, monkeypatch):
    """Parked vehicles are among the boxes. The set is one that readers accept."""
    more = dict(settings=STUDY["settings"] | STREET, layers=["depth", "instance", "semantic"])
    generation = make_generation(STUDY | more, tmp_path)
    told = []
    found = estimate(generation, progress=lambda done, total: told.append((done, total)))
    assert told == [(n, 4) for n in range(1, 5)]
    assert not list(tmp_path.iterdir())  # nothing is left behind
    monkeypatch.setattr(chunk, "_worker", chunk.WorkerState())
    writer = DatasetWriter(generation, prepare_folder(tmp_path / "out"), "embedded")
    for plan in generation.scenarios:
        made_up.record(writer, plan)
        assert writer.finish(plan)
    writer.clear()
    check_set(tmp_path / "out", attenuation=ATTENUATION)
    made = statistics(tmp_path / "out")
    plan = generation.scenarios[0]
    parked, _ = parked_vehicles(scene_of(plan.source, plan.build))
    assert len(parked.kind)
    for split in made.splits:
        assert split.boxes == sum(found.boxes[split.name].values())
    assert sum(found.boxes.values(), Counter()) == Counter(made.boxes)
    own = sum(f.stat().st_size for f in (tmp_path / "out").rglob("-*/*"))
    assert found.size == pytest.approx(own, rel=0.1)
