"""Light and weather: the equation they solve, figures worked out by hand, and what they reach."""

import numpy as np
import pytest
import worlds
from worlds import SMALL, place_sensors, world

from inspe_jax import Case, Conditions, device, evaluate, evaluate_many, optimise
from inspe_jax.core.errors import InspeError
from inspe_jax.sensing.conditions import effective_depth

CAMERA, LIDAR = device("ideal-camera").spec, device("ideal-lidar-64").spec


@pytest.mark.parametrize("depth", [5.0, 30.0, 200.0])
@pytest.mark.parametrize("extinction", [1e-6, 0.01, 0.3])
def test_what_clear_air_leaves_at_the_depth_is_left_at_the_effective_one(depth, extinction):
    z = effective_depth(depth, extinction)
    assert z < depth
    assert z * np.exp(extinction * z) == pytest.approx(depth, rel=1e-9)


def test_the_paper_s_camera_in_three_lights_and_a_lidar_that_brings_its_own():
    """About 30 m by day and 10 m by night."""
    depths = [Conditions.of(light).spec(CAMERA).depth for light in ("midday", "dusk", "night")]
    np.testing.assert_allclose(depths, [30, 20, 10])
    assert Conditions.of("night").spec(LIDAR) == LIDAR


@pytest.mark.parametrize("kind", ["rain", "fog"])
@pytest.mark.parametrize("spec", [CAMERA, LIDAR], ids=lambda spec: spec.kind)
def test_more_rain_and_thicker_fog_are_worse(kind, spec):
    amounts = {"rain": (0.1, 1, 10, 50, 200), "fog": (50_000, 1000, 200, 50, 10)}[kind]
    got = [Conditions.of("midday", f"{kind}:{n}").spec(spec) for n in amounts]
    reach = np.array([g.grid.reach for g in got])
    sure = np.array([g.reliability for g in got])
    assert got == [spec.with_performance(g.reliability, g.grid.reach) for g in got]
    assert (np.diff(reach) < 0).all()
    assert (np.diff(sure) <= 0).all()
    assert reach[0] > 0.98 * spec.grid.reach  # hardly any is hardly felt
    assert sure[0] > 0.98 * spec.reliability


def test_rain_and_fog_by_hand():
    """Rain of 10 mm/h: 1.58 · 10^0.63 = 6.74 dB/km, 1.55 per km: 100 m become z with
    z exp(0.00155 z) = 100, so 87.3 m. Fog of 200 m: k = ln 20 / 200; 30 m become 21.7 m."""
    assert Conditions.of("midday", "rain:10").spec(LIDAR).reach == pytest.approx(87.3, abs=0.1)
    assert Conditions.of("midday", "fog:200").spec(CAMERA).depth == pytest.approx(21.7, abs=0.05)


def test_the_usual_intensity_leaves_the_published_share():
    for weather, spec, share in (
        ("rain", LIDAR, 44.5 / 52.3),
        ("fog", LIDAR, 42.2 / 52.3),
        ("rain", CAMERA, 1.0),
        ("fog", CAMERA, np.mean([72.54, 64.79]) / 91.55),
    ):
        assert Conditions.of("midday", weather).spec(spec).reliability == pytest.approx(
            share, abs=0.005
        )
    night = (13.5 / 33.7) / (35.4 / 62.8)
    assert Conditions.of("night").spec(CAMERA).reliability == pytest.approx(night, abs=0.005)


def test_names_are_read_and_written():
    around = Conditions.of(" Night ", "FOG:75.5")
    assert Conditions.of(*str(around).split(", ")) == around
    assert str(Conditions()) == "midday, clear"
    assert Conditions("night", "rain") == Conditions.of("night", "rain:10")


@pytest.mark.parametrize(("light", "weather", "message"), [
    ("noon", "clear", r"light 'noon': one of midday, dusk, night"),
    ("nihgt", "clear", r"did you mean night\?"),
    ("midday", "snow", r"weather 'snow': one of clear, rain, fog"),
    ("midday", "clear:1", r"clear weather has no intensity"),
    ("midday", "rain:", r"weather rain:nan: give rain:NUMBER, between 0.1 and 200 mm/h"),
    ("midday", "rain:-3", r"between 0.1 and 200 mm/h"),
    ("midday", "fog:1", r"fog:NUMBER, between 10 and 50000 m of met"),
])  # fmt: skip
def test_bad_input(light, weather, message):
    with pytest.raises(InspeError, match=message):
        Conditions.of(light, weather)


# ── In scores ───────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def scene():
    return world(**SMALL)


@pytest.fixture(scope="module")
def layout():
    camera, lidar = [9.0, 9.0, 6.0, 0, -0.3, -2.3], [-9.0, 9.0, 5.0, 0, 0, 0]
    return place_sensors((worlds.CAMERA, camera), (worlds.LIDAR, lidar))


def test_scores_are_those_of_the_sensors_as_they_are_then(scene, layout):
    around = Conditions.of("night", "fog:100")
    scores = evaluate(scene, layout, conditions=around)
    by_hand = evaluate(scene, around.layout(layout))
    assert scores.surrogate == by_hand.surrogate
    assert (scores.settings["light"], scores.settings["weather"]) == ("night", "fog:100")
    many = evaluate_many(scene, layout, [layout.poses], conditions=around)
    assert many.surrogate[0] == pytest.approx(scores.surrogate, abs=1e-6)
    # It is checked as it was bought: fog makes it none for another scene.
    high = layout.with_poses(layout.poses + [0, 0, 6, 0, 0, 0])
    assert evaluate(scene, high, conditions="night, fog:10").surrogate < scores.surrogate
    clear = evaluate(scene, layout)
    for name in ("coverage", "information_gain", "surrogate"):
        assert getattr(scores, name) < getattr(clear, name)


def test_scores_and_searches_take_conditions_in_the_same_ways(scene, layout):
    night = Conditions.of("night", "rain:10")
    case = Case(scene, night)
    scores = evaluate(scene, layout, conditions=night)
    assert evaluate(scene, layout, conditions="night, rain:10") == scores == evaluate(case, layout)
    rain = Case(scene, Conditions.of("midday", "rain:10"))
    assert evaluate(scene, layout, conditions="rain:10") == evaluate(rain, layout) != scores
    for start in (
        optimise(scene, layout, "random", evaluations=1, conditions=night),
        optimise([case], layout, "random", evaluations=1),
    ):
        assert start.scores_before == scores
        assert start.settings["scenes"][0] | night.record == start.settings["scenes"][0]


def test_conditions_that_are_none_are_refused(scene, layout):
    for wrong, message in (
        (3, "conditions: got 3, of type int; give Conditions, or their text, such as 'night"),
        ("nigth", "light 'nigth': one of midday, dusk, night; did you mean night"),
    ):
        with pytest.raises(InspeError, match=message):
            evaluate(scene, layout, conditions=wrong)
    with pytest.raises(InspeError, match="conditions: given twice, as midday, clear and as dusk"):
        evaluate(Case(scene), layout, conditions="dusk")
