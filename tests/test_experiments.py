"""What experiments tell of their rows."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import readme_tables
import real_deployments
import table1
from common import read_rows
from scipy.stats import pearsonr

from inspe_jax.sensing.catalogue import device

HERE = Path(table1.__file__).parent
README = (HERE / "README.md").read_text(encoding="utf-8")
ROWS = read_rows(HERE / "table1.csv")


def test_the_tables_of_the_readme_are_those_of_the_rows():
    assert readme_tables.with_tables(README) == README
    with pytest.raises(ValueError, match="slopes: 0 places"):
        readme_tables.with_tables("")


@pytest.mark.parametrize("conditions", ["recorded", "usual"])
def test_correlations_are_those_of_the_rows(conditions):
    keys = ("less", "road_user", "metric", "correlation", "value", "low", "high")
    scores, kept = (
        [r for r in read_rows(HERE / f"table1_{name}.csv") if r["conditions"] == conditions]
        for name in ("scores", "correlations")
    )
    for of in table1.HELD_OUT:
        own = {(r["placement"], r["metric"]): (float(r["mean"]), 0.0)
               for r in scores if r["frames_of"] == of}  # fmt: skip
        correlated = table1.correlations(table1.means(ROWS, of), own)
        found = [[str(row[key]) for key in keys] for row in correlated]
        assert found == [[row[key] for key in keys] for row in kept if row["frames_of"] == of]


def test_intervals_are_fishers():
    """They hold what is true in 95 % of samples, and 5 % have p < 0.05 where two are the same."""
    rng, groups, holds = np.random.default_rng(0), np.repeat(range(3), 10), []
    both = [[1, 0.8, 0.8], [0.8, 1, 0.5], [0.8, 0.5, 1]]
    for y, x, z in rng.multivariate_normal([0] * 3, both, (400, 30)).swapaxes(1, 2):
        for name, true in (("pearson", 0.8), ("spearman", 6 / np.pi * np.arcsin(0.4))):
            _, low, high = table1.correlation(x + 9 * groups, y - 9 * groups, groups, name)
            holds.append(low < true < high)
        holds.append(table1.p_beside(x, z - 9 * groups, y + 9 * groups, groups) > 0.05)
    assert 0.92 < np.mean(holds) < 0.97
    ends = table1.correlation(x, y, [0] * 30, "pearson")[1:]
    np.testing.assert_allclose(ends, pearsonr(x, y).confidence_interval())
    assert np.isnan(table1.correlation(groups, y, groups, "pearson")).all()
    # By hand: r = 0.9, artanh 1.4722 ± 1.95996 √(1.405 / 6) = 0.9485.
    nine, swapped = np.arange(9), np.array([1, 0, 3, 2, 5, 4, 8, 6, 7])
    found = table1.correlation(nine, swapped, [0] * 9, "spearman")
    assert found == pytest.approx((0.9, 0.4806, 0.9843), abs=1e-3)


def test_baselines_by_hand():
    columns = np.stack(np.meshgrid(*[np.arange(-99.5, 100)] * 2), -1).reshape(-1, 2)
    scene = SimpleNamespace(voxels=SimpleNamespace(columns=columns))
    specs = (device(f"paper-{name}").spec for name in ("camera", "lidar-32"))
    poses, sensors = [[50, 50, 5, 0, 0, 3], [-50] * 6], [SimpleNamespace(spec=s) for s in specs]
    found = table1.baselines(scene, SimpleNamespace(sensors=sensors, poses=poses))
    area = (38**2 * np.radians(100) / 2 + 50**2 * np.pi) / 200**2  # a sector and a disc
    assert found.pop("area") == pytest.approx(area, rel=0.01)
    assert found == dict(sensors=2, log_lidars=np.log(2), rays=160 * 120 + 32 * 1280)


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


def test_scores_beside_ap_over_spacings_by_hand():
    """AP falls and rises: a score that is AP finds it, one that rises with the spacing finds its
    end, and outliers do not count."""
    ap, own = [3, 1, 2, 9], dict.fromkeys(real_deployments.SCORED, 0)
    rows = [dict(place="a", spacing=f"{s}") | own | dict(surrogate=ap[s], coverage=2 * s)
            for s in range(4)]  # fmt: skip
    rows = [row | dict(occlusion=-s, information_gain=s % 2, detectability=s * s)
            for s, row in enumerate(rows)]  # fmt: skip
    table = [dict(spacing_m=f"{s}", flag="outlier" * (s == 3), ap50=f"{v / 100}")
             for s, v in enumerate(ap)]  # fmt: skip
    found = {row["score"]: row for row in real_deployments.compared(rows, table, 5)}
    assert [found[key]["lost"] for key in ("surrogate", "spacing", "sensors")] == [0, 1, 1]
    assert [found[key]["correlation"] for key in ("surrogate", "spacing")] == [1, -0.5]
    assert found["surrogate"]["given_spacing"] == pytest.approx(1)
    assert found["coverage"]["given_spacing"] == 0
    assert np.isnan([found[key]["given_spacing"] for key in ("spacing", "sensors")]).all()
