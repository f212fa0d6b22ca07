"""A result on disk: what comes back, what the files say to others, and what is refused."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from worlds import world

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import read_csv
from inspe_jax.placement.result import FILES, FORMAT, Result, load_result, save_result
from inspe_jax.placement.run import Progress
from inspe_jax.scoring import metrics
from inspe_jax.scoring.evaluate import evaluate
from inspe_jax.sensing.catalogue import device
from inspe_jax.sensing.layout import Sensor, Unit, make_layout


@pytest.fixture(scope="module")
def result():
    scene = world(radius=10, voxel=1.0)
    spec = device("paper-camera").spec
    sensors = [Sensor("a", spec, 0), Sensor("b", spec, 1)]
    units = [Unit("north", (9.0, 8.0, 0.1)), Unit("south", (-9.0, -8.0, -0.1))]
    poses = np.array([[9, 8.5, 6, 0, -0.4, -2.2], [-9, -8, 5.0, 0, -0.3, 0.7]])
    start = make_layout(sensors, units, poses, "by hand")
    layout = replace(start, poses=poses + [0.1, -0.2, 0.3, 0, 0.05, 0.2], name="better")
    return Result(
        layout=layout,
        start=start,
        scores_before=evaluate(scene, start),
        scores=evaluate(scene, layout),
        objective_before=0.1 + 0.2,
        objective=1 / 3,
        history=(Progress(0.5, 1.0, 0.3, 0.3), Progress(1 / 7, 2 / 3, 1e-9, 0.3)),
        path=poses[None],
        evaluations=2.5,
        seconds=1.25,
        status="converged",
        method="made up",
        seed=3,
        settings={"objective": {"weights": (0.3, 0.5, 0.2)}, "heights": np.array([3.0, 12.0])},
        versions={"python": "3"},
        notes=("unit 'north' moved 3.20 m to the nearest mounting area",),
    )


def test_a_result_comes_back(result, tmp_path):
    folder = tmp_path / "new"
    save_result(result, folder)
    assert sorted(path.name for path in folder.iterdir()) == sorted(FILES)
    assert json.loads((folder / "result.json").read_text())["objective"] == 1 / 3
    rows = read_csv(folder / "history.csv")
    assert list(rows[0]) == ["seconds", "evaluations", "score", "best"]
    assert [row["best"] for row in rows] == ["0.3", "0.3"]
    record = json.loads((folder / "result.json").read_text())
    assert record["scores"]["surrogate"] == result.scores.surrogate
    back = load_result(folder)
    for name in ("layout", "start"):
        mine, theirs = getattr(result, name), getattr(back, name)
        np.testing.assert_allclose(theirs.poses, mine.poses, atol=1e-8)
        for part in ("sensors", "units", "name"):
            assert getattr(theirs, part) == getattr(mine, part)
    for name in ("scores", "scores_before"):
        mine, theirs = getattr(result, name), getattr(back, name)
        assert len(theirs.seen_share) == 0
        assert metrics.weights_of(theirs.settings["weights"]) == metrics.weights_of()
        for part in fields(mine):
            if part.name not in ("settings", "seen_share"):
                assert getattr(theirs, part.name) == getattr(mine, part.name)
    np.testing.assert_allclose(back.path, result.path, atol=1e-8)
    assert back.settings == {"objective": {"weights": [0.3, 0.5, 0.2]}, "heights": [3.0, 12.0]}
    others = {"layout", "start", "scores", "scores_before", "path", "settings"}
    for name in {field.name for field in fields(Result)} - others:
        assert getattr(back, name) == getattr(result, name), name  # numbers to the last digit
    save_result(replace(result, seed=4), folder)  # in its place
    assert load_result(folder).seed == 4
    assert sorted(path.name for path in folder.iterdir()) == sorted(FILES)


def test_what_is_no_result_is_refused(result, tmp_path):
    with pytest.raises(InspeError, match="no such folder"):
        load_result(tmp_path / "none")
    with pytest.raises(InspeError, match=r"result\.json: no such file"):
        load_result(tmp_path)
    save_result(result, tmp_path)
    good = (tmp_path / "result.json").read_text()
    record = json.loads(good)
    for content in (
        "",
        "[]",
        good.replace(FORMAT, "inspe_jax results"),
        json.dumps(record | {"surprise": 1}),
        json.dumps({k: v for k, v in record.items() if k != "seed"}),
        json.dumps(record | {"scores": {}}),
    ):
        (tmp_path / "result.json").write_text(content)
        with pytest.raises(InspeError, match=r"not (a result saved by this package|JSON)"):
            load_result(tmp_path)
    (tmp_path / "result.json").write_text(good.replace(FORMAT, FORMAT[:-1] + "1"))
    (tmp_path / "path.csv").rename(tmp_path / "kept.csv")
    with pytest.raises(InspeError, match="of another version of inspe_jax"):
        load_result(tmp_path)
    (tmp_path / "kept.csv").rename(tmp_path / "path.csv")
    (tmp_path / "result.json").write_text(good)
    (tmp_path / "history.csv").write_text("seconds,evaluations,score,best\n1,2,x,4\n")
    with pytest.raises(InspeError, match="not a result"):
        load_result(tmp_path)
