"""What the figure of a Pareto front and its table show, read back from them."""

import io
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from inspe_jax.core.errors import InspeError
from inspe_jax.placement.studies.pareto import DeviceMix
from inspe_jax.report.curves import NAMED, pareto_view
from inspe_jax.report.tables import pareto_table
from inspe_jax.scoring.evaluate import ManyScores


def mix_of(count, cost, objective, front):
    values = np.array([0.5, 0.4, 0.3])
    metrics = dict(zip(("coverage", "occlusion", "information_gain"), values, strict=True))
    scores = ManyScores(metrics, objective)
    result = SimpleNamespace(
        objective=objective, scores=scores, method="random", settings={"scenes": [{"name": "here"}]}
    )
    return DeviceMix({"device": count}, cost, result, front)


@pytest.fixture
def found():
    return [mix_of(1, 100, 0.2, True), mix_of(2, 150, 0.1, False), mix_of(3, 300, 0.6, True)]


def test_the_front_is_a_staircase_with_its_mixes_named(found):
    fig = pareto_view(found)
    (ax,) = fig.axes
    stairs, front, beaten = ax.lines
    assert stairs.get_drawstyle() == "steps-post"
    assert list(zip(*front.get_data(), strict=True)) == [(100, 0.2), (300, 0.6)]
    assert list(zip(*beaten.get_data(), strict=True)) == [(150, 0.1)]
    words = [text.get_text() for text in fig.texts]
    named = [text for text in words if " device: " in text]
    assert named == ["1 device: 100 US dollars, 0.2000", "3 device: 300 US dollars, 0.6000"]
    assert [text.get_text() for text in ax.texts] == ["1", "2"]
    assert "Cost against score at here" in words


def test_no_more_are_named_than_there_is_room_for(found):
    many = [mix_of(k, 100 * k, 1 - 0.5**k, True) for k in range(1, NAMED + 9)]
    fig = pareto_view(many)
    assert len(fig.axes[0].texts) == NAMED
    assert "1 device: 100 US dollars, 0.5000" in [text.get_text() for text in fig.texts]
    assert f"{NAMED + 8} device" not in " ".join([text.get_text() for text in fig.texts])


def test_one_mix_is_a_figure_too(found):
    (ax,) = pareto_view([replace(found[0], cost=0.0)]).axes
    assert ax.lines[1].get_data()[0].tolist() == [0.0]
    with pytest.raises(InspeError, match="no mix"):
        pareto_view([])


def test_the_table_has_a_row_a_mix(found):
    file = io.StringIO()
    Console(file=file, width=120).print(pareto_table(found))
    rows = [line for line in file.getvalue().splitlines() if "device" in line]
    assert [("front" in row) for row in rows] == [True, False, True]
    assert "0.6000" in rows[2]
