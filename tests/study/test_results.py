"""Rows on disk: appended whole, taken up again, and put in order at the end."""

import pytest

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import csv_text, read_csv
from inspe_jax.jobs.sources import versions
from inspe_jax.study.plan import make_study
from inspe_jax.study.sweep import Results, columns, failed_row, row_head


@pytest.fixture
def study(tmp_path):
    return make_study(
        dict(scenes=[{"built_in": "four_way"}], layouts=["L-c"], settings=dict(seed=[0, 1, 2])),
        tmp_path,
    )


def row(job):
    return row_head(job) | versions() | dict(surrogate="0.5", status="done", error="")


def test_rows_are_on_disk_as_they_come_and_in_order_at_the_end(study, tmp_path):
    folder = tmp_path / "out"
    with Results(study, folder) as results:
        for count, job in enumerate(reversed(study.jobs), 1):
            results.add(row(job), "a layout\n")
            assert len(read_csv(folder / "results.csv")) == count
        rows = results.finish()
    assert [r["key"] for r in rows] == [job.key for job in study.jobs]
    assert read_csv(folder / "results.csv") == rows
    assert list(rows[0]) == list(columns(study))
    assert rows[1]["seed"] == "1"
    assert (folder / "layouts" / f"{study.jobs[0].key}.yaml").read_text() == "a layout\n"


def test_a_row_cut_short_is_dropped(study, tmp_path):
    folder, path = tmp_path / "out", tmp_path / "out" / "results.csv"
    with Results(study, folder) as results:
        for job in study.jobs[:2]:
            results.add(row(job))
    whole = path.read_bytes()
    ends = [k + 1 for k, byte in enumerate(whole) if byte == ord("\n")]
    near = {end + k for end in ends for k in (-2, -1, 0, 1) if end + k <= len(whole)}
    for end in sorted(near | set(range(0, len(whole), 29))):
        path.write_bytes(whole[:end])
        with Results(study, folder) as results:
            lines = whole[:end].count(b"\n")
            assert len(results.rows) == max(0, lines - 1), end
            for job in study.jobs:
                if job.key not in results.rows:
                    results.add(row(job))
            assert [r["key"] for r in results.finish()] == [job.key for job in study.jobs]


def test_tags_are_those_that_the_study_has_now(tmp_path):
    def tagged(kind):
        scene = {"built_in": "four_way", "tags": {"kind": kind}}
        return make_study(dict(scenes=[scene], layouts=["L-c"]), tmp_path)

    before, now = tagged("T"), tagged("four-way")
    with Results(before, tmp_path / "out") as results:
        results.add(row(before.jobs[0]))
    with Results(now, tmp_path / "out") as results:
        assert [r["tag_kind"] for r in results.finish()] == ["four-way"]


def test_only_one_run_at_a_time(study, tmp_path):
    used = pytest.raises(InspeError, match="is in use by another run")
    with Results(study, tmp_path / "out"), used:
        Results(study, tmp_path / "out")
    with Results(study, tmp_path / "out"):
        pass


def test_what_failed_is_run_again(study, tmp_path):
    bad, good, _ = study.jobs
    with Results(study, tmp_path / "out") as results:
        results.add(failed_row(bad, InspeError("two\nlines, and a comma")))
        results.add(row(good))
    assert read_csv(tmp_path / "out" / "results.csv")[0]["error"] == "two lines, and a comma"
    with Results(study, tmp_path / "out") as results:
        assert set(results.rows) == {good.key}
        results.add(row(bad))
        assert [r["status"] for r in results.finish()] == ["done", "done"]


def test_results_of_something_else_are_left_alone(study, tmp_path):
    folder = tmp_path / "out"
    with Results(study, folder) as results:
        results.add(row(study.jobs[0]))
    scene, layouts = {"built_in": "four_way"}, ["L-c"]
    content = dict(scenes=[scene], layouts=layouts, settings=dict(seed=9))
    with pytest.raises(InspeError, match="1 of its 1 rows are not jobs of this study, such as L-c"):
        Results(make_study(content, tmp_path), folder)
    tagged = dict(scenes=[scene | {"tags": {"a": "b"}}], layouts=layouts)
    with pytest.raises(InspeError, match="its columns are not those of this study"):
        Results(make_study(tagged, tmp_path), folder)
    path = folder / "results.csv"
    for text in (b"my own notes", b"\xff\xfe\n", b"a,b\n1,2\n"):
        (tmp_path / "other").mkdir(exist_ok=True)
        (tmp_path / "other" / "results.csv").write_bytes(text)
        with pytest.raises(InspeError, match="its columns are not"):
            Results(study, tmp_path / "other")
        assert (tmp_path / "other" / "results.csv").read_bytes() == text
    rows = read_csv(folder / "results.csv")
    rows[0]["jax"] = "0.0.1"
    path.write_text(csv_text(rows))
    with pytest.raises(InspeError, match=r"was begun with jax 0.0.1, but this is"):
        Results(study, folder)
