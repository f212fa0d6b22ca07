"""What experiments tell of their rows."""

from pathlib import Path

import numpy as np
import pytest
import readme_tables
import table1
from common import read_rows

from inspe_jax.simulation.frame import KINDS

HERE = Path(table1.__file__).parent
README = (HERE / "README.md").read_text(encoding="utf-8")
ROWS = read_rows(HERE / "table1.csv")


def test_the_tables_of_the_readme_are_those_of_the_rows():
    assert readme_tables.with_tables(README) == README
    with pytest.raises(ValueError, match="slopes: 0 places"):
        readme_tables.with_tables("")


def test_correlations_are_those_of_the_rows(monkeypatch):
    monkeypatch.setattr(table1, "interval", lambda *of: (np.nan, np.nan))
    kept = {
        tuple(row[key] for key in ("frames_of", "road_user", "metric", "correlation")): row["value"]
        for row in read_rows(HERE / "table1_correlations.csv")
    }
    count, scores = 0, read_rows(HERE / "table1_scores.csv")
    for of in table1.HELD_OUT:
        own = {(r["placement"], r["metric"]): (float(r["mean"]), 0.0)
               for r in scores if r["frames_of"] == of}  # fmt: skip
        for row in table1.correlations(table1.means(ROWS, of), own):
            at = of, row["road_user"], row["metric"], row["correlation"]
            assert float(kept[at]) == pytest.approx(row["value"], abs=6e-4)  # of three digits
            count += 1
    assert count == 2 * (1 + len(KINDS)) * 4 * 2


@pytest.mark.parametrize("of", ["places", "time"])
def test_a_placement_is_one_observation_however_many_seeds(of):
    """The interval of the README's table, by the formula: mean ± t s/√3, with t of 2 degrees."""
    rows, t = [*ROWS, *read_rows(HERE / "found_placements.csv")], 4.302653

    def mean_ap(placement):
        at = ("coalign", placement, of)
        own = [r for r in rows if (r["model"], r["placement"], r["frames_of"]) == at]
        return 100 * np.mean([float(row["ap"]) for row in own])

    gains = [mean_ap(f"found from {name}") - mean_ap(name) for name in ("L-d1", "L-d2", "L-c")]
    mean, half = np.mean(gains), t * np.std(gains, ddof=1) / 3**0.5
    gain = f"{mean:+.1f} [{mean - half:.1f}, {mean + half:.1f}]"
    assert gain in readme_tables.found_placements()
