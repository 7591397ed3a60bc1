"""The scenario: what walks where, under which controller and disturbance, as one validated YAML file."""

from __future__ import annotations

import difflib
import json
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Strict,
    Tag,
    ValidationError,
    WrapValidator,
    model_validator,
)
from pydantic_core import ErrorDetails, PydanticCustomError

MAX_FILE_BYTES = 1_000_000
MAX_NESTING = 20
MAX_STEPS = 10_000_000
_PATHS = (("robot", "file"), ("ground", "map", "file"))  # keys whose values are paths


class ConfigError(ValueError):
    """A scenario that cannot be used; in one line: file, dotted key, what was expected, what was got."""


# ------------------------------------------------------------------------------------------------------------
# Value types. Each says in words what it expects, whatever the way in which a value fails.


def _failure(expected: str, **context: Any) -> PydanticCustomError:
    """The one kind of error that the models raise; context: a `key` below the model and the value `got`."""
    return PydanticCustomError("expected", "expected {expected}", {"expected": expected, **context})


def _expects(text: str) -> WrapValidator:
    def validate(value: Any, handler: Callable[[Any], Any]) -> Any:
        try:
            return handler(value)
        except ValidationError:
            raise _failure(text) from None

    return WrapValidator(validate)


def _is_permutation(limbs: tuple[str, ...]) -> tuple[str, ...]:
    if len(set(limbs)) != len(limbs):
        raise ValueError("a limb comes twice")
    return limbs


def _is_name(text: str) -> str:
    if not text.strip() or not text.isprintable():
        raise ValueError("empty or unprintable")
    return text


_Finite = Annotated[float, Strict(), Field(allow_inf_nan=False)]  # strict: no booleans, no strings
_Limb = Literal["LF", "LH", "RH", "RF"]

Number = Annotated[_Finite, _expects("a finite number")]
Positive = Annotated[_Finite, Field(gt=0), _expects("a finite number above 0")]
NonNegative = Annotated[_Finite, Field(ge=0), _expects("a finite number, 0 or above")]
Duty = Annotated[_Finite, Field(ge=0.75, lt=1), _expects("a number from 0.75 to below 1")]
Angle = Annotated[_Finite, Field(ge=-2 * math.pi, le=2 * math.pi), _expects("an angle in rad between -2 pi and 2 pi")]
Limit = Annotated[NonNegative | None, _expects("a finite number, 0 or above, or null")]
Vector = Annotated[tuple[_Finite, _Finite, _Finite], _expects("a list of three finite numbers")]
Gain = Annotated[
    Positive | tuple[Positive, Positive, Positive, Positive, Positive, Positive],
    _expects("a finite number above 0, or a list of six"),
]
Sequence4 = Annotated[
    tuple[_Limb, _Limb, _Limb, _Limb],
    AfterValidator(_is_permutation),
    _expects("the four limbs LF, LH, RH, RF, each once, in any order"),
]
Pair = Annotated[tuple[_Finite, _Finite], _expects("a list of two finite numbers")]
Name = Annotated[str, Strict(), AfterValidator(_is_name), _expects("the name of a robot")]
Word = Annotated[str, Strict(), AfterValidator(_is_name), _expects("a name in the robot's file")]
FileName = Annotated[str, Strict(), AfterValidator(_is_name), _expects("the path of a file")]
Heights = Annotated[
    tuple[_Finite, ...], Field(min_length=1), _expects("a list of one finite number or more, foothold after foothold")
]
ThreeWords = Annotated[tuple[Word, Word, Word], _expects("a list of three joint names, from the base outwards")]


# ------------------------------------------------------------------------------------------------------------
# Models, key by key as in the YAML


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Gait(_Section):
    """Periodic crawl with one limb in the air at a time."""

    cycle: Positive = Field(default=4.0, description="period of the gait, s; a whole number of time steps")
    duty: Duty = Field(default=0.75, description="share of the cycle that each limb is gripped, 1; 0.75 to below 1")
    stride: NonNegative = Field(default=0.05, description="way of the base per cycle, m")
    step_height: Positive = Field(default=0.03, description="height of a swing foot's arc over the ground, m")
    sequence: Sequence4 = Field(default=("LH", "LF", "RH", "RF"), description="order in which the limbs swing")
    base_reference: Literal["nominal", "actual"] = Field(
        default="nominal",
        description="where each cycle's base reference starts: where planned, or where the base is",
    )
    heading: Angle = Field(default=0.0, description="direction of walking and initial yaw about world z, rad")


class Footholds(_Section):
    """Heights of each limb's footholds in the order in which it uses them, the first included; the last one stays."""

    LF: Heights = Field(default=(0.0,), description="left front, m")
    LH: Heights = Field(default=(0.0,), description="left hind, m")
    RH: Heights = Field(default=(0.0,), description="right hind, m")
    RF: Heights = Field(default=(0.0,), description="right front, m")


class HeightMap(_Section):
    """Heights on a grid: rows along y, columns along x; a PNG's top row is its far side, the largest y."""

    file: FileName = Field(description="grid, .csv, .npy or .png (grey, 0 to 1); beside the config, if relative")
    resolution: Positive = Field(description="distance between neighbouring samples, m")
    origin: Pair = Field(default=(-0.5, -0.5), description="x and y of the sample with the smallest x and y, m")
    scale: Number = Field(default=1.0, description="height of one unit of the file, m")


class Ground(_Section):
    """Uneven ground; flat at height zero unless one of these is given."""

    footholds: Footholds | None = Field(default=None, description="a height for each foothold")
    map: HeightMap | None = Field(default=None, description="a height map, read at the planned footholds")

    @model_validator(mode="after")
    def _one_of_them(self) -> Ground:
        if self.footholds is not None and self.map is not None:
            raise _failure("footholds or map, not both", key="map", got=self.map.file)
        return self


class Contact(_Section):
    """Spring-damper between a gripped foot and its grip point."""

    stiffness: Positive = Field(default=1.0e4, description="contact stiffness per axis, N/m")
    damping: NonNegative = Field(default=20.0, description="contact damping per axis, N s/m")
    holding_limit: Limit = Field(
        default=15.0, description="force above which a pulled gripper lets go, N; null: grippers never let go"
    )


class Control(_Section):
    """Joint loop and an admittance law around it. Six values: translations x, y, z, then rotations."""

    controller: Literal["pd", "base_admittance", "end_effector_admittance"] = Field(
        default="base_admittance",
        description="pd (gait alone), base_admittance (paper Eq. 3), or end_effector_admittance (Eq. 2)",
    )
    reading: Literal["virtual_model", "measured_pose"] = Field(
        default="virtual_model",
        description="form of Eq. 3 in discrete time: own state, or measured base motion",
    )
    inertia: Gain = Field(default=1.0, description="virtual inertia M, kg (translations), kg m^2 (rotations)")
    damping: Gain = Field(default=5.0e3, description="virtual damping D, N s/m (translations), N m s/rad (rotations)")
    stiffness: Gain = Field(default=5.0e4, description="virtual stiffness K, N/m (translations), N m/rad (rotations)")
    kp: Positive = Field(default=50.0, description="proportional gain of the joint loop, N m/rad")
    kd: NonNegative = Field(default=0.2, description="derivative gain of the joint loop, N m s/rad")

    @model_validator(mode="after")
    def _reading_fits(self) -> Control:
        if self.controller == "end_effector_admittance" and self.reading != "virtual_model":
            expected = "virtual_model with end_effector_admittance (measured_pose reads base_admittance only)"
            raise _failure(expected, key="reading", got=self.reading)
        return self


class _Window(_Section):
    """A span of time, start <= t < stop."""

    if TYPE_CHECKING:  # each kind of window has them in its own order
        start: float
        stop: float | None

    @model_validator(mode="after")
    def _in_order(self) -> _Window:
        start, stop = self.start, self.stop
        if stop is not None and not start < stop:
            raise _failure(f"a time after start = {start:g} s, or null", key="stop", got=stop)
        return self


class Cargo(_Window):
    """Point mass that sits at the base's centre of mass for a while."""

    mass: NonNegative = Field(default=0.0, description="mass, kg; 0: no cargo")
    start: NonNegative = Field(default=2.0, description="time of loading, s")
    stop: Limit = Field(default=None, description="time of unloading, s; null: stays until the end")


class Push(_Window):
    """Constant wrench on the base for a while."""

    force: Vector = Field(description="force on the base, world axes, N")
    moment: Vector = Field(default=(0.0, 0.0, 0.0), description="moment on the base, world axes, N m")
    start: NonNegative = Field(description="first instant, s")
    stop: Limit = Field(default=None, description="last instant, s; null: until the end")


class Disturbance(_Section):
    """What happens to the robot on its way."""

    cargo: Cargo = Field(default=Cargo(), description="cargo on the base")
    pushes: tuple[Push, ...] = Field(default=(), description="pushes on the base; they add up where they overlap")


class Limb(_Section):
    """One limb of a robot from a file."""

    joints: ThreeWords = Field(description="names of its three revolute joints, from the base outwards")
    foot: Word = Field(description="name of the site, body or link that is the foot")
    foothold: Pair = Field(
        description="where the foot stands in the rest stance: x ahead, y left, base link's frame, m"
    )


class Limbs(_Section):
    """The four limbs of a robot from a file."""

    LF: Limb = Field(description="left front")
    LH: Limb = Field(description="left hind")
    RH: Limb = Field(description="right hind")
    RF: Limb = Field(description="right front")


class RobotFile(_Section):
    """A robot of one's own; its base link's axes are x ahead, y left, z up."""

    file: FileName = Field(description="MJCF (.xml) or URDF (.urdf); beside the config, if the path is relative")
    height: Positive = Field(description="height of the base link's frame over the ground in the rest stance, m")
    limbs: Limbs = Field(description="joints and feet")


def _kind_of_robot(value: Any) -> str:
    return "name" if isinstance(value, str) or not isinstance(value, (Mapping, RobotFile)) else "file"


AnyRobot = Annotated[
    Annotated[Name, Tag("name")] | Annotated[RobotFile, Tag("file")],
    Discriminator(_kind_of_robot),
]


class Scenario(_Section):
    """One walk of one robot, fully specified. Immutable and hashable."""

    robot: AnyRobot = Field(default="hubrobo_v3_2", description="name of the robot, or one's own from a file")
    gravity: Vector = Field(default=(0.0, 0.0, -9.81), description="gravity, world axes, m/s^2; a slope tilts it")
    duration: Positive = Field(default=8.0, description="length of the walk, s; a whole number of time steps")
    time_step: Positive = Field(default=0.001, description="time step of the simulation, s")
    gait: Gait = Field(default=Gait(), description="how the limbs move")
    ground: Ground = Field(default=Ground(), description="heights of the footholds")
    contact: Contact = Field(default=Contact(), description="how the grippers hold the ground")
    control: Control = Field(default=Control(), description="controller and gains")
    disturbance: Disturbance = Field(default=Disturbance(), description="cargo and pushes")

    @model_validator(mode="after")
    def _whole_steps(self) -> Scenario:
        for key, span in (("duration", self.duration), ("gait.cycle", self.gait.cycle)):
            steps = span / self.time_step
            if steps > MAX_STEPS:
                raise _failure(f"at most {MAX_STEPS} time steps of {self.time_step:g} s", key=key, got=span)
            if round(steps) < 1 or not math.isclose(steps, round(steps), rel_tol=1e-9):
                raise _failure(f"a whole number of time steps of {self.time_step:g} s", key=key, got=span)
        if round((1 - self.gait.duty) * self.gait.cycle / self.time_step) < 2:
            expected = f"a swing, (1 - duty) cycle, of two time steps of {self.time_step:g} s or more"
            raise _failure(expected, key="gait.duty", got=self.gait.duty)
        return self

    @property
    def steps(self) -> int:
        """Number of time steps of the walk."""
        return round(self.duration / self.time_step)

    def to_yaml(self) -> str:
        """The resolved scenario as YAML; loading it gives an equal scenario."""
        data = self.model_dump(mode="json")
        return yaml.dump(data, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=110)

    @classmethod
    def from_yaml(cls, text: str, source: str = "scenario") -> Scenario:
        """The scenario in a YAML text, as `to_yaml` writes it; `source` names it in the `ConfigError` of a bad one."""
        return _validated(_parse(text, source), source)

    def with_files(self, change: Callable[[str, str], str]) -> Scenario:
        """A copy with the paths in it changed; `change` is given a dotted key and its path."""
        data = self.model_dump(mode="json")
        found = {".".join(keys): _at(data, keys) for keys in _PATHS}
        changed = {key: change(key, file) for key, file in found.items() if file is not None}
        return self.with_overrides(changed)

    def relative_to(self, folder: str | os.PathLike[str]) -> Scenario:
        """A copy in which paths of files inside a folder are relative to it."""
        folder = Path(folder).absolute()
        return self.with_files(
            lambda _, file: Path(file).relative_to(folder).as_posix() if Path(file).is_relative_to(folder) else file
        )

    def beside(self, folder: str | os.PathLike[str]) -> Scenario:
        """A copy whose relative paths start at a folder, the reverse of `relative_to`."""
        return self.with_files(lambda _, file: str(Path(folder).absolute() / file))

    def with_overrides(self, overrides: Sequence[str] | Mapping[str, Any]) -> Scenario:
        """A revalidated copy with some keys changed; `overrides` as in `load_scenario`."""
        return _overridden(self, overrides, "scenario")


def load_scenario(path: str | os.PathLike[str], overrides: Sequence[str] | Mapping[str, Any] = ()) -> Scenario:
    """Read a scenario from a YAML file, then change some keys.

    **Arguments:**

    - `path`: the file. Keys that it leaves out take their defaults.
    - `overrides`: strings "dotted.key=value" with the value in YAML, or a mapping from dotted keys to values.
        Lists are indexed by number, as in `disturbance.pushes.0.start`. A mapping as a value changes only the
        keys that it names.

    **Returns:** the `Scenario`.

    **Raises:** `ConfigError`, also for overrides. The file must be valid before the overrides apply.
    """
    source = os.fsdecode(path)
    return _overridden(_validated(_beside(_parse(_read(source), source), source), source), overrides, source)


# ------------------------------------------------------------------------------------------------------------
# YAML: the core schema of YAML 1.2, in which 2e3 is a number, and no tags, anchors, aliases or duplicate keys


class _Loader(yaml.SafeLoader):
    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012 (PyYAML's own protocol)
    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = yaml.SafeLoader.peek_event(self)
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) or getattr(event, "tag", None):
            raise yaml.MarkedYAMLError(
                problem="tags, anchors and aliases are not used here", problem_mark=event.start_mark
            )
        if self.depth == MAX_NESTING:
            raise yaml.MarkedYAMLError(problem=f"nested deeper than {MAX_NESTING}", problem_mark=event.start_mark)
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if key.tag != "tag:yaml.org,2002:str":
                raise yaml.MarkedYAMLError(problem="a key is not a word", problem_mark=key.start_mark)
            if key.value in seen:
                raise yaml.MarkedYAMLError(problem=f"key {key.value!r} comes twice", problem_mark=key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)

    def construct_integer(self, node: Any) -> int | float:
        # Decimal even with leading zeros. A huge one, too long for int(), becomes a float, perhaps inf.
        return int(node.value) if len(node.value) < 18 else float(node.value)


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_integer)
for _tag, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+", list("-+0123456789")),
    (
        "float",
        r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(rf"(?:{_pattern})\Z"), _first)


class _Dumper(yaml.SafeDumper):
    yaml_implicit_resolvers = _Loader.yaml_implicit_resolvers  # quotes what would load as a number


def _at(data: Any, keys: Sequence[str]) -> Any:
    """The value at some keys of nested mappings, None where there is none."""
    for key in keys:
        data = data.get(key) if isinstance(data, dict) else None
    return data


def _beside(data: Any, source: str) -> Any:
    """The data of a file with the relative paths in it as seen from here: they start at the file's folder."""
    for *sections, key in _PATHS:
        values = _at(data, sections)
        if isinstance(values, dict) and isinstance(values.get(key), str) and "\0" not in values[key]:
            values[key] = str(Path(source).parent.absolute() / values[key])
    return data


def _read(source: str) -> str:
    try:
        with Path(source).open("rb") as file:
            content = file.read(MAX_FILE_BYTES + 1)
    except (OSError, ValueError) as error:  # ValueError: a null byte in the path
        raise _error(source, "", "a readable file", (getattr(error, "strerror", None) or str(error)).lower()) from None
    if len(content) > MAX_FILE_BYTES:
        raise _error(source, "", f"at most {MAX_FILE_BYTES} bytes", "more")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise _error(source, "", "UTF-8 text", f"byte 0x{content[error.start]:02x} at offset {error.start}") from None


def _parse(text: str, source: str, key: str = "") -> Any:
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        reason = getattr(error, "problem", None) or getattr(error, "reason", None) or "not YAML"
        line = f"line {mark.line + 1}: " if mark is not None and not key else ""
        raise _error(source, key, "valid YAML", f"{line}{reason}") from None


# ------------------------------------------------------------------------------------------------------------
# Overrides


def _overridden(scenario: Scenario, overrides: Sequence[str] | Mapping[str, Any], source: str) -> Scenario:
    if not overrides:
        return scenario
    data = scenario.model_dump(mode="json")
    try:
        for key, value in _pairs(overrides, source):
            _assign(data, key, value, source)
        return _validated(data, source)
    except RecursionError:
        raise _error(source, "", "overrides of a few levels", "endless nesting") from None


def _pairs(overrides: Sequence[str] | Mapping[str, Any], source: str) -> list[tuple[str, Any]]:
    if isinstance(overrides, Mapping):
        return list(overrides.items())
    pairs = []
    for text in [overrides] if isinstance(overrides, str) else overrides:
        key, equals, value = text.partition("=") if isinstance(text, str) else ("", "", "")
        if not (key.strip() and equals and value.strip()):  # an empty value would be a silent null
            raise _error(source, "", "an override of the form dotted.key=value", _show(text))
        pairs.append((key.strip(), _parse(value, source, key.strip())))
    return pairs


def _assign(data: dict[str, Any], key: Any, value: Any, source: str) -> None:
    """Set `key` (dotted) of the nested mapping `data` to `value`; a mapping sets the keys that it names."""
    if not isinstance(key, str) or not all(key.split(".")):
        raise _error(source, "", "an override of the form dotted.key=value", _show(key))
    if isinstance(value, Mapping):
        if not value:
            raise _error(source, key, "a mapping with at least one key", "{}")
        for name, inner in value.items():
            _assign(data, f"{key}.{name}", inner, source)
        return
    parts = key.split(".")
    target: Any = data
    for level, part in enumerate(parts):
        place = ".".join(parts[:level])
        last = level == len(parts) - 1
        if isinstance(target, list):
            if not (part.isascii() and part.isdecimal() and len(part) < 9 and int(part) < len(target)):
                raise _error(source, place, f"an index below {len(target)}", _show(part))
            index: Any = int(part)
        elif isinstance(target, dict):
            index = part
            if not last:
                target.setdefault(part, {})
                if target[part] is None or (place == "" and part == "robot" and isinstance(target[part], str)):
                    target[part] = {}  # a section takes the place of none, a robot's file that of a name
        else:
            raise _error(source, place, "no further keys below this one", _show(part))
        if last:
            target[index] = _plain(value)
        else:
            target = target[index]


def _plain(value: Any) -> Any:
    """Numpy and JAX numbers and arrays as Python's own."""
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value.tolist() if hasattr(value, "tolist") else value


# ------------------------------------------------------------------------------------------------------------
# Errors


def _validated(data: Any, source: str) -> Scenario:
    try:
        return Scenario.model_validate(data)
    except ValidationError as invalid:
        errors = invalid.errors(include_url=False)
        raise _explained(errors[0], source, len(errors) - 1) from None


def _explained(error: ErrorDetails, source: str, more: int) -> ConfigError:
    """The pydantic error in the words of `ConfigError`."""
    where, context, got = error["loc"], error.get("ctx", {}), _show(error["input"])
    if len(where) > 1 and where[0] == "robot":
        where = where[:1] + where[2:]  # without the tag of the kind
    match error["type"]:
        case "expected":
            where += tuple(context["key"].split(".")) if "key" in context else ()
            expected = context["expected"]
            got = _show(context["got"]) if "got" in context else got
        case "extra_forbidden":
            expected, got = "a known key", f"an unknown one{_suggestion(where)}"
        case "missing":
            expected, got = "a value", "none"
        case "literal_error":
            expected = context["expected"]
        case "tuple_type":
            expected = "a list"
        case _:
            expected = f"a mapping with keys {', '.join(_section(where).model_fields)}"
    return _error(source, ".".join(map(str, where)), expected, got, more)


def _section(where: Sequence[str | int]) -> type[BaseModel]:
    """The model at a place in the scenario."""
    model: type[BaseModel] = Scenario
    for part in where:
        if isinstance(part, str):
            model = _model_in(model.model_fields[part].annotation)
    return model


def _model_in(annotation: Any) -> Any:
    """The model in an annotation: itself, an item of a list, or one of several kinds."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    found = (_model_in(part) for part in get_args(annotation))
    return next((model for model in found if model is not None), None)


def _suggestion(where: Sequence[str | int]) -> str:
    """The nearest key of the same section or, failing that, of another one."""
    name, beside = str(where[-1]), list(_section(where[:-1]).model_fields)
    if near := difflib.get_close_matches(name, beside, 1):
        return f" (did you mean {near[0]}?)"
    places = [f"{key}.{inner}" for key in Scenario.model_fields for inner in _keys(key)]
    near = difflib.get_close_matches(name, [place.split(".")[-1] for place in places], 1)
    return f" (did you mean {' or '.join(place for place in places if place.endswith('.' + near[0]))}?)" if near else ""


def _keys(key: str) -> list[str]:
    kind = Scenario.model_fields[key].annotation
    return list(kind.model_fields) if isinstance(kind, type) and issubclass(kind, BaseModel) else []


def _show(value: Any) -> str:
    """A value as it would stand in YAML, cut to a readable length."""
    try:
        text = json.dumps(value, default=repr, ensure_ascii=False)
    except (TypeError, ValueError):  # odd keys, cycles
        text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _error(source: str, key: str, expected: str, got: str, more: int = 0) -> ConfigError:
    place = f"{source}: {key}" if key else source
    text = f"{place}: expected {expected}, got {got}" + (f" (and {more} more)" if more else "")
    return ConfigError("".join(c if c.isprintable() else ascii(c)[1:-1] for c in text))  # one line, encodable
