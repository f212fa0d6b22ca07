"""Options: what a command's signature and docstring say of them becomes the command line's.

:func:`command` adds a function to the command line. Its positional parameters are arguments, the
others are options, with their types and defaults; a parameter that is a dataclass stands for the
options that are its fields. The section ``Args`` of the docstring, or ``Attributes`` of the
dataclass, has the help of each::

    name: Help.
    name (FILE.csv): Help, with what the value is called.
    name (--other FILE.csv): Help of an option that is not called as its parameter.

:data:`SHARED` has the help of parameters that mean the same in all commands.
"""

import copy
import functools
import inspect
import re
from collections.abc import Callable, Container
from dataclasses import asdict, dataclass, fields, is_dataclass
from math import isnan
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer

from inspe_jax.cli.common import PANELS, app, busy
from inspe_jax.core.errors import InspeError, error_at
from inspe_jax.core.files import check_input
from inspe_jax.mounting.mixes import mix_name
from inspe_jax.placement.constraints import Constraints
from inspe_jax.placement.objective import Objective
from inspe_jax.placement.optimise import DEFAULT_METHOD, check_search
from inspe_jax.placement.problem import Case, Problem
from inspe_jax.placement.run import check_budget
from inspe_jax.scene.procedural.built_ins import BUILT_INS
from inspe_jax.scene.regions import weights_of_regions
from inspe_jax.scene.scene import Scene, check_scene_name, load_scene
from inspe_jax.scoring.detection import DetectionCurves, detection_curves, load_detection
from inspe_jax.scoring.metrics import names_of, weights_of
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout

SHARED = """
    source (SCENE): A built-in intersection, or a scene saved as .npz.
    sensors (LAYOUT): A layout file (.yaml, or .geojson of `inspe export`), or the name of a
        strategy.
    light: Light: midday, dusk or night.
    weather: Weather: clear, rain:10 (10 mm/h), or fog:200 (optical range 200 m).
    profile (NAME): Profile for a scene that is built: paper (used if not given) or ideal; see
        `inspe profiles`.
    plot (FILE): Draw a figure: .png, .svg or .pdf.
    record (--json FILE|-): Write the result as JSON; - prints it instead.
    detection (FILE.toml|json): Curves of detectability in place of the usual ones: a table for each
        kind of sensor and class, such as [lidar.pedestrian] with most, half and slope. What is not
        in the file keeps the usual curve.
    price (DEVICE=USD): Price of a device, in place of the catalogue's; repeat it for other devices.
    device (DEVICE:COUNTS): A device of the catalogue, and the numbers of it to try, such as 0-4 or
        0,4,8; repeat it for other devices. velodyne-vlp-16:1-4 if not given.
    method: Search method, such as grid. `inspe compare` lists and compares all methods.
    start: Start of a search: given (the layout) or random.
    scheduler (ADDRESS): Address of a running Dask scheduler, such as tcp://host:8786; if not given,
        this machine's cores are used.
    workers: Processes on this machine; one per core if not given.
    data (DIR): A data set, one split of it, or one scenario.
    recorded (CACHE): The cache of a data set, as `inspe dataset cache` makes it.
    split: Split of the set.
    run (RUN): The folder of a training.
    driving_side (left|right): Side of the road that traffic of an OpenStreetMap extract drives on,
        in place of its country's.
    folder (--out DIR): Folder for the results.
    force: Replace files that this command did not write, or were changed.
"""

Whole = Annotated[int, typer.Option(min=0)]
Positive = Annotated[int, typer.Option(min=1)]

_Command = Callable[..., None]


def command(group: typer.Typer = app, name: str | None = None) -> Callable[[_Command], _Command]:
    """A decorator that adds a function to a group of commands, as the module says."""

    def decorate(function: _Command) -> _Command:
        words, _, own = inspect.cleandoc(function.__doc__ or "").partition("\nArgs:\n")
        records: dict[str, type] = {}
        parameters: list[inspect.Parameter] = []
        hints = get_type_hints(function, include_extras=True)
        for one in inspect.signature(function).parameters.values():
            if not is_dataclass(record := hints[one.name]):
                parameters.append(_parameter(one, hints[one.name], _helps(SHARED) | _helps(own)))
                continue
            assert isinstance(record, type)
            records[one.name] = record
            types = get_type_hints(record, include_extras=True)
            helps = _helps(SHARED)
            for base in reversed(record.__mro__):
                helps |= _helps(inspect.cleandoc(base.__doc__ or "").partition("Attributes:")[2])
            helps |= _helps(own)
            for field in fields(record):
                option = one.replace(name=field.name, default=field.default)
                parameters.append(_parameter(option, types[field.name], helps))
        # In the help, what is written and replaced comes last.
        parameters.sort(key=lambda p: (p.kind == p.KEYWORD_ONLY, p.name in ("folder", "force")))

        @functools.wraps(function)
        def called(**given: Any) -> None:
            made = {
                key: record(**{field.name: given.pop(field.name) for field in fields(record)})
                for key, record in records.items()
            }
            function(**given, **made)

        called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        called.__annotations__ = {one.name: one.annotation for one in parameters}
        panel = PANELS[name or function.__name__] if group is app else None
        group.command(name, help=words, rich_help_panel=panel)(called)
        return function

    return decorate


def _helps(text: str) -> dict[str, tuple[str, str]]:
    """What a section of a docstring says of each parameter: what is in brackets, and the help."""
    found = re.findall(r"^    (\w+)(?: \((\S.*?)\))?: (.*(?:\n     +.*)*)", text, re.MULTILINE)
    return {name: (brackets, " ".join(words.split())) for name, brackets, words in found}


def _parameter(
    one: inspect.Parameter, hint: Any, helps: dict[str, tuple[str, str]]
) -> inspect.Parameter:
    """A parameter with what Typer must know of it."""
    brackets, words = helps[one.name]
    flag = re.match(r"--\S+", brackets)
    metavar = brackets[flag.end() if flag else 0 :].strip() or None
    if one.kind != one.KEYWORD_ONLY:
        return one.replace(annotation=Annotated[hint, typer.Argument(metavar=metavar, help=words)])
    name = flag[0] if flag else "--" + one.name.replace("_", "-")
    if one.default is True and not flag:
        name += f"/--no-{name[2:]}"
    info = typer.Option()
    if get_origin(hint) is Annotated:  # with bounds
        hint, bounds = get_args(hint)
        info = copy.copy(bounds)
    info.default, info.metavar, info.help = name, metavar, words
    return one.replace(annotation=Annotated[hint, info])


@dataclass(frozen=True)
class MapOptions:
    """What scenes are built with; what is None is as the profile has it.

    Attributes:
        radius: Radius of the region of interest [m].
        voxel: Edge of a voxel [m].
        density: Traffic: none, low, medium, high (0, 20, 40, 60 road users), or a number.
        frames: Number of frames of traffic; 100 if not given.
        statics (none|map|street): Bodies that stand in every frame and hide what is behind them:
            none (if not given); map, the buildings, trees, walls and poles of an OpenStreetMap
            extract or of OpenDRIVE's objects; or street, made-up parked vehicles, trees, walls,
            posts and bus shelters.
    """

    radius: float | None = None
    voxel: float | None = None
    density: str | None = None
    frames: int | None = None
    statics: str | None = None

    @property
    def given(self) -> dict[str, Any]:
        """Those that are given, by name."""
        return {name: value for name, value in asdict(self).items() if value is not None}


@dataclass(frozen=True)
class SceneOptions(MapOptions):
    """All that one scene is built with.

    Attributes:
        profile (NAME): Profile: it sets the options of the scene that are not given, and how scores
            are read; paper if not given. See `inspe profiles`.
        spacing: Score one voxel in each cell of this edge [m]. If not given: the profile's value
            where --voxel is the profile's too, and otherwise every voxel.
        step: Time from one frame to the next [s]; 1 if not given.
        mix: Road users: mixed, fleet (sizes as varied as real ones), or largest (only the paper's
            largest vehicle).
        traffic (waypoints|sumo|FILE): Traffic model: waypoints (the paper's; used if not given) or
            sumo (on maps); or a recording: tracks (.csv), or a log of CARLA's recorder (.log).
        seed: Seed of the traffic; 0 if not given.
        terrain (none|ground): Whether the ground hides what is behind its brows: none (if not
            given) or ground.
        region_weight (NAME=VALUE): Weight of a region in the scores, such as
            crosswalk=0.5; repeat it for others. Regions that you do not name get 0. The paper's if
            not given.
    """

    profile: str | None = None
    spacing: float | None = None
    step: float | None = None
    mix: str | None = None
    traffic: str | None = None
    seed: int | None = None
    terrain: str | None = None
    region_weight: list[str] | None = None

    @property
    def given(self) -> dict[str, Any]:
        """Those that are given, by name."""
        found, form = super().given, "NAME=VALUE, such as crosswalk=0.5"
        if self.region_weight:
            found["region_weight"] = numbers("--region-weight", self.region_weight, form)
            weights_of_regions(found["region_weight"])
        return found


@dataclass(frozen=True)
class DetectionOptions:
    """In which light and weather road users are detected, and by which curves."""

    light: str = "midday"
    weather: str = "clear"
    profile: str | None = None
    detection: Path | None = None

    @property
    def conditions(self) -> Conditions:
        """The light and the weather."""
        return Conditions.of(self.light, self.weather)

    def curves(self) -> DetectionCurves | None:
        """The curves of ``--detection``. Raises InspeError if the file holds no such curves."""
        return None if self.detection is None else load_detection(self.detection)


@dataclass(frozen=True)
class WeightOptions(DetectionOptions):
    """How layouts are scored: weights in P_sm, and further metrics.

    Attributes:
        weight (NAME=VALUE): Weight of a metric in P_sm, such as coverage=0.3; repeat it for other
            metrics. Metrics that you do not name get 0, and all weights must sum to 1. Without this
            option every metric has its usual weight (see `inspe metrics`).
        metrics (A,B,…|all): Further metrics to compute, such as detectability; see `inspe metrics`.
            Those with weight are computed in any case.
    """

    weight: list[str] | None = None
    metrics: str = ""

    def objective(self, **others: Any) -> Objective:
        """The objective that these options are of, checked."""
        form = "NAME=VALUE, such as coverage=0.3"
        wanted = Objective(
            weights=weights_of(numbers("--weight", self.weight, form) if self.weight else None),
            metrics=names_of(self.metrics),
            detection=self.curves(),
            **others,
        )
        wanted.check()
        return wanted


@dataclass(frozen=True)
class ScoreOptions(WeightOptions):
    """The weights, and what alone counts: regions, and classes of road users.

    Attributes:
        region: Count only this region: driveway, junction, crosswalk, sidewalk or shoulder; repeat
            it for more. For metrics that are means over places, such as detectability.
        road_user: Count only this class of road users: car, truck, cyclist or pedestrian; repeat it
            for more. For detectability, points on target and localisation.
    """

    region: list[str] | None = None
    road_user: list[str] | None = None

    def curves(self) -> DetectionCurves | None:
        """The curves of ``--detection``, for the classes of ``--road-user``."""
        curves = super().curves()
        if not self.road_user:
            return curves
        return (curves or detection_curves()).for_road_users(self.road_user)

    def sought(self, case: Case, layout: Layout) -> float | None:
        """The score of a layout's goal; None if it is P_sm, or these options say what counts."""
        if layout.goal is None or self.weight or self.region or self.road_user:
            return None
        return Problem(case, layout, Objective.of_goal(layout.goal, self.curves())).exact_of(layout)

    def objective(self, **others: Any) -> Objective:
        """The objective that these options are of, checked."""
        return super().objective(regions=tuple(self.region or ()), **others)


@dataclass(frozen=True)
class SearchOptions(ScoreOptions):
    """The options of every command that searches: budget, objective and constraints.

    Attributes:
        seconds: Time of each search [s], without compiling that it waits for. Without a budget, 60;
            20 in commands that run several searches.
        evaluations: Work of each search, in exact scores; the same seed then gives the same result
            on the same machine.
        also (SCENE): Another scene of the same intersection, with other traffic; repeat it for
            more. The mean score over the scenes is maximised.
        worst: With several scenes, maximise the worst score, not the mean.
        failures: N−1: maximise the mean score over the failures of one unit each.
        places ([UNIT=]PLACES): Where units may stand: any, areas, poles, or keep (where they are).
            For a single unit write, for example, 'corner 1=keep'; repeat it for other units.
        heights (LOW HIGH): Heights of sensors above the ground [m].
        light (A,B,…): Light: midday, dusk or night; each one given counts as a scene.
    """

    seconds: float | None = None
    evaluations: float | None = None
    also: list[str] | None = None
    worst: bool = False
    failures: bool = False
    places: list[str] | None = None
    heights: tuple[float, float] = (3.0, 12.0)

    def seconds_each(self) -> float | None:
        """Seconds for each search, in a command that runs several."""
        return 20.0 if self.seconds is None and self.evaluations is None else self.seconds

    def each_light(self) -> list[Conditions]:
        """The conditions: every light that is given, with the weather."""
        return [Conditions.of(light, self.weather) for light in self.light.split(",")]

    def cases(self, scene: Scene) -> list[Case]:
        """The scene and those of ``--also``, each in every light that is given."""
        with busy("reading the other scenes"):
            worlds = [scene, *(load_scene(other, self.profile) for other in self.also or ())]
        return [Case(world, conditions) for world in worlds for conditions in self.each_light()]

    def checked(self, **objective: Any) -> tuple[Objective, Constraints]:
        """The objective and the constraints, checked before any scene is read."""
        lights = self.each_light()
        if self.worst and not self.also and len(lights) == 1:
            raise InspeError(
                "--worst needs several scenes: add scenes with --also, or give more than one light"
            )
        check_budget(self.seconds_each(), self.evaluations)
        over = "worst" if self.worst else "mean"
        wanted = self.objective(over=over, failures=self.failures, **objective)
        constraints = Constraints(places=_places(self.places or []), heights=self.heights)
        constraints.check()
        for other in self.also or ():  # before another scene is built
            check_scene_name(other)
            if other not in BUILT_INS:
                check_input(Path(other))
        return wanted, constraints


@dataclass(frozen=True)
class DeviceOptions(SearchOptions):
    """The options of commands that search with one method, also among mixes of devices.

    Attributes:
        seed: Seed of the search.
    """

    method: str = DEFAULT_METHOD
    seed: int = 0
    device: list[str] | None = None
    price: list[str] | None = None

    def of_mixes(
        self, callback: Callable[[float, float, str], None], **more: Any
    ) -> dict[str, Any]:
        """How a search of many mixes of devices goes."""
        return dict(
            **more,
            method=self.method,
            seconds=self.seconds_each(),
            evaluations=self.evaluations,
            seed=self.seed,
            progress=lambda row, done, best: callback(done, best, mix_name(row)),
        )

    def checked(self, start: str = "given", **objective: Any) -> tuple[Objective, Constraints]:
        """The objective with prices, and the constraints; the method is checked too."""
        wanted, constraints = super().checked(prices=prices(self.price), **objective)
        check_search((self.method,), start, (self.seed,))
        return wanted, constraints


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


def parts_of(
    option: str, text: str, mark: str, kind: Callable[[str], Any], counts: Container[int], form: str
) -> tuple[Any, ...]:
    """The numbers in an option's text, between marks. Raises InspeError for any other text."""
    parts = text.split(mark)
    with error_at(f"--{option} {text}: write {form}", ValueError):
        return tuple(map(kind, parts if len(parts) in counts else [""]))


def prices(given: list[str] | None) -> dict[str, float]:
    """Prices by device from ``DEVICE=USD``. Raises InspeError for any other text."""
    return numbers("--price", given, "DEVICE=USD, such as hesai-xt32=5000")


def numbers(option: str, given: list[str] | None, form: str) -> dict[str, float]:
    """Numbers by name from ``NAME=NUMBER``, in the order in which they are given."""
    found: dict[str, float] = {}
    for text in given or ():
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


def device_counts(given: list[str] | None) -> dict[str, list[int]]:
    """Numbers of each device to try, from ``DEVICE:0-4`` or ``DEVICE:0,4,8``."""
    found: dict[str, list[int]] = {}
    for text in given or ("velodyne-vlp-16:1-4",):
        name, _, several = text.rpartition(":")
        try:
            low, to, high = several.partition("-")
            numbers = [*range(int(low), int(high) + 1)] if to else [*map(int, low.split(","))]
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
