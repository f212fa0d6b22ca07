"""Options that several commands share: records of options, and a decorator that adds them."""

import functools
import inspect
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from inspe_jax.cli.common import ProfileOption, WeatherOption, check_scene
from inspe_jax.core.errors import InspeError

if TYPE_CHECKING:
    from inspe_jax.placement.constraints import Constraints
    from inspe_jax.placement.objective import Objective
    from inspe_jax.placement.problem import Case
    from inspe_jax.scene.scene import Scene
    from inspe_jax.scoring.detection import DetectionCurves
    from inspe_jax.sensing.conditions import Conditions
    from inspe_jax.sensing.layout import Layout

PriceOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="DEVICE=USD",
        help="Price of a device, in place of the catalogue's; repeat it for other devices.",
    ),
]
MethodOption = Annotated[
    str | None,
    typer.Option(
        help="Search method, such as grid; greedy-adam if not given. `inspe compare` lists and "
        "compares all methods."
    ),
]
DetectionOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.toml|json",
        help="Curves of detectability in place of the usual ones: a table for each kind of sensor "
        "and class, such as [lidar.pedestrian] with most, half and slope. What is not in the file "
        "keeps the usual curve.",
    ),
]
DEFAULT_DEVICES = ("velodyne-vlp-16:1-4",)
DeviceCountsOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="DEVICE:COUNTS",
        help="A device of the catalogue, and the numbers of it to try, such as 0-4 or 0,4,8; "
        f"repeat it for other devices. {DEFAULT_DEVICES[0]} if not given.",
    ),
]
SchedulerOption = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Address of a running Dask scheduler, such as tcp://host:8786; if not given, this "
        "machine's cores are used.",
    ),
]
WorkersOption = Annotated[
    int | None, typer.Option(help="Processes on this machine; one per core if not given.")
]
OutOption = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results.")]


@dataclass(frozen=True)
class WeightOptions:
    """The weights of metrics in P_sm, by name, which metrics to compute besides, and the curves of
    detectability."""

    weight: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="Weight of a metric in P_sm, such as coverage=0.3; repeat it for other metrics. "
            "Metrics that you do not name get 0, and all weights must sum to 1. Without this "
            "option every metric has its usual weight (see `inspe metrics`).",
        ),
    ] = None
    metrics: Annotated[
        str,
        typer.Option(
            metavar="A,B,…|all",
            help="Further metrics to compute, such as detectability; see `inspe metrics`. Those "
            "with weight are computed in any case.",
        ),
    ] = ""
    detection: DetectionOption = None

    def weights(self) -> dict[str, float]:
        """The weight of every metric. Raises InspeError if the weights are not valid."""
        from inspe_jax.scoring.metrics import weights_of

        return weights_of(_weights(self.weight) if self.weight else None)

    def curves(self) -> "DetectionCurves | None":
        """The curves of ``--detection``. Raises InspeError if the file holds no such curves."""
        from inspe_jax.scoring.detection import load_detection

        return None if self.detection is None else load_detection(self.detection)

    def further(self) -> tuple[str, ...]:
        """The names of the further metrics. Raises InspeError if one is of no metric."""
        from inspe_jax.scoring.metrics import chosen, names_of

        chosen(self.metrics)
        return names_of(self.metrics)


def _weights(given: list[str]) -> dict[str, float]:
    """Weights by metric from ``NAME=VALUE``. Raises InspeError for any other text."""
    return _numbers("--weight", given, "NAME=VALUE, such as coverage=0.3")


@dataclass(frozen=True)
class ScoreOptions(WeightOptions):
    """The weights, and what alone counts: regions, and classes of road users."""

    region: Annotated[
        list[str] | None,
        typer.Option(
            help="Count only this region: driveway, junction, crosswalk, sidewalk or shoulder; "
            "repeat it for more. For metrics that are means over places, such as detectability."
        ),
    ] = None
    road_user: Annotated[
        list[str] | None,
        typer.Option(
            help="Count only this class of road users: car, truck, cyclist or pedestrian; repeat "
            "it for more. For detectability, points on target and localisation."
        ),
    ] = None

    @property
    def given(self) -> bool:
        """Whether any of them says what counts."""
        return any((self.weight, self.region, self.road_user))

    def curves(self) -> "DetectionCurves | None":
        """The curves of ``--detection``, for the classes of ``--road-user``."""
        from inspe_jax.scoring.detection import detection_curves

        curves = super().curves()
        if not self.road_user:
            return curves
        return (curves or detection_curves()).for_road_users(self.road_user)

    def sought(self, case: "Case", layout: "Layout", **readings: str | None) -> float | None:
        """The score of what a layout was searched for; None where that is P_sm, or these options
        say what counts."""
        from inspe_jax.placement.objective import Objective
        from inspe_jax.placement.problem import Problem

        if layout.goal is None or self.given:
            return None
        objective = Objective.of_goal(layout.goal, self.curves(), **readings)
        return Problem(case, layout, objective).exact_of(layout)

    def objective(self, **others: Any) -> "Objective":
        """The objective that these options are of, checked."""
        from inspe_jax.placement.objective import Objective

        wanted = Objective(
            weights=self.weights(),
            metrics=self.further(),
            detection=self.curves(),
            regions=tuple(self.region or ()),
            **others,
        )
        wanted.check()
        return wanted


@dataclass(frozen=True)
class SearchOptions(ScoreOptions):
    """The options of every command that searches: budget, objective and constraints."""

    seconds: Annotated[
        float | None,
        typer.Option(help="Time of each search [s], without compiling that it waits for. Without a "
                     "budget, 60; 20 in commands that run several searches."),
    ] = None  # fmt: skip
    evaluations: Annotated[
        float | None,
        typer.Option(
            help="Work of each search, in exact scores; the same seed then gives the same "
            "result on the same machine."
        ),
    ] = None
    also: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SCENE",
            help="Another scene of the same intersection, with other traffic; repeat it for more. "
            "The mean score over the scenes is maximised.",
        ),
    ] = None
    worst: Annotated[
        bool,
        typer.Option(
            "--worst", help="With several scenes, maximise the worst score, not the mean."
        ),
    ] = False
    failures: Annotated[
        bool,
        typer.Option(
            "--failures", help="N−1: maximise the mean score over the failures of one unit each."
        ),
    ] = False
    places: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[UNIT=]PLACES",
            help="Where units may stand: any, areas, poles, or keep (where they are). For a single "
            "unit write, for example, 'corner 1=keep'; repeat it for other units.",
        ),
    ] = None
    heights: Annotated[
        tuple[float, float],
        typer.Option(metavar="LOW HIGH", help="Heights of sensors above the ground [m]."),
    ] = (3.0, 12.0)
    light: Annotated[
        str,
        typer.Option(
            metavar="A,B,…", help="Light: midday, dusk or night; each one given counts as a scene."
        ),
    ] = "midday"
    weather: WeatherOption = "clear"
    profile: ProfileOption = None

    def seconds_each(self) -> float | None:
        """Seconds for each search, in a command that runs several."""
        return 20.0 if self.seconds is None and self.evaluations is None else self.seconds

    def of_mixes(
        self, method: str | None, seed: int, callback: Callable[[float, float, str], None]
    ) -> dict[str, Any]:
        """Method, budget, seed and progress of a command that searches many mixes of devices."""
        from inspe_jax.mounting.mixes import mix_name
        from inspe_jax.placement.optimise import DEFAULT_METHOD

        return dict(
            method=method or DEFAULT_METHOD,
            seconds=self.seconds_each(),
            evaluations=self.evaluations,
            seed=seed,
            progress=lambda row, done, best: callback(done, best, mix_name(row)),
        )

    def conditions(self) -> "list[Conditions]":
        """The conditions: every light that is given, with the weather."""
        from inspe_jax.sensing.conditions import Conditions

        return [Conditions.of(light, self.weather) for light in self.light.split(",")]

    def cases(self, scene: "Scene") -> "list[Case]":
        """The scene and those of ``--also``, each in every light that is given."""
        from inspe_jax.placement.problem import Case
        from inspe_jax.scene.scene import load_scene

        worlds = [scene, *(load_scene(other, self.profile) for other in self.also or ())]
        return [Case(world, conditions) for world in worlds for conditions in self.conditions()]

    def checked(self, **objective: Any) -> "tuple[Objective, Constraints]":
        """The objective and the constraints, checked before any scene is read."""
        from inspe_jax.placement.constraints import Constraints
        from inspe_jax.placement.run import check_budget

        conditions = self.conditions()
        if self.worst and not self.also and len(conditions) == 1:
            raise InspeError(
                "--worst needs several scenes: add scenes with --also, or give more than one light"
            )
        check_budget(self.seconds_each(), self.evaluations)
        over = "worst" if self.worst else "mean"
        wanted = self.objective(over=over, failures=self.failures, **objective)
        constraints = Constraints(places=_places(self.places or []), heights=self.heights)
        constraints.check()
        for other in self.also or ():
            check_scene(other)
        return wanted, constraints


def takes(record: type) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A decorator for commands whose last argument, ``options``, is of this record.

    The fields of the record become options of the command.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        hints = get_type_hints(record, include_extras=True)
        own = dict(inspect.signature(command).parameters)
        del own["options"]
        added = {
            f.name: inspect.Parameter(
                f.name,
                inspect.Parameter.POSITIONAL_OR_KEYWORD,
                default=inspect.Parameter.empty if f.default is MISSING else f.default,
                annotation=hints[f.name],
            )
            for f in fields(record)
        }

        @functools.wraps(command)
        def called(**given: Any) -> None:
            command(
                **{name: given[name] for name in own},
                options=record(**{name: given[name] for name in added}),
            )

        # The folder for results comes last in the help, and whether it is written over.
        last = ("folder", "force")
        everything = sorted([*own.values(), *added.values()], key=lambda p: p.name in last)
        called.__signature__ = inspect.Signature(everything)  # type: ignore[attr-defined]
        called.__annotations__ = {p.name: p.annotation for p in everything}
        return called

    return decorate


def _places(given: list[str]) -> str | dict[str, str]:
    """Where units may stand: all of them, or by name. Raises InspeError if both are given."""
    named = dict(text.rsplit("=", 1) for text in given if "=" in text)
    whole = [text for text in given if "=" not in text]
    if len(whole) + bool(named) > 1 or len(named) + len(whole) < len(given):
        raise InspeError(
            f"--places {' '.join(given)}: give it once for all units, or once for each unit that "
            "you name; other units may then stand anywhere"
        )
    return named or (whole[0] if whole else "any")


def prices(given: list[str] | None) -> dict[str, float]:
    """Prices by device from ``DEVICE=USD``. Raises InspeError for any other text."""
    return _numbers("--price", given or [], "DEVICE=USD, such as hesai-xt32=5000")


def importances(given: list[str] | None) -> dict[str, float]:
    """Importance by junction from ``ID=WEIGHT``. Raises InspeError for any other text."""
    return _numbers("--importance", given or [], "ID=WEIGHT, such as 189=2")


def _numbers(option: str, given: list[str], form: str) -> dict[str, float]:
    """Numbers by name from ``NAME=NUMBER``, in the order in which they are given."""
    found: dict[str, float] = {}
    for text in given:
        name, _, number = text.partition("=")
        try:
            value = float(number.replace(",", ""))
        except ValueError:
            value = float("nan")
        if not name.strip() or isnan(value):
            raise InspeError(f"{option} {text}: write {form}")
        if name.strip() in found:
            raise InspeError(f"{option} {text}: {name.strip()} is given twice")
        found[name.strip()] = value
    return found


def counts(given: list[str]) -> dict[str, list[int]]:
    """Numbers of each device to try, from ``DEVICE:0-4`` or ``DEVICE:0,4,8``."""
    found: dict[str, list[int]] = {}
    for text in given:
        name, _, several = text.rpartition(":")
        try:
            low, to, high = several.partition("-")
            numbers = (
                list(range(int(low), int(high) + 1)) if to else [int(n) for n in low.split(",")]
            )
        except ValueError:
            numbers = []
        if not name or not numbers:
            raise InspeError(
                f"--device {text}: write DEVICE:COUNTS, such as hesai-xt32:0-4 or hesai-xt32:0,2,4"
            )
        if name in found:
            raise InspeError(f"--device {text}: {name} is given twice")
        found[name] = numbers
    return found
