"""The scenario: robot, ground, gait, controller and disturbances, key by key as in its YAML."""

from __future__ import annotations

import math
import operator
import os
from collections.abc import Callable, ItemsView, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, ValidationError, model_validator

from mjx_climb.scenario import declared, registers
from mjx_climb.scenario import values as v
from mjx_climb.scenario.kinds import Controller, shipped_kinds
from mjx_climb.scenario.messages import OTHER_TAG, PLAIN_TAG, ConfigError, failure, refusal
from mjx_climb.scenario.registers import RegisterScale
from mjx_climb.scenario.values import setting
from mjx_climb.scenario.yaml_text import Dumper, assign, pairs, parse

MAX_STEPS = 10_000_000
MAX_DELAY = 500  # time steps: each is a sample of a buffer, which a step reads whole
MIN_LIMBS, MAX_LIMBS = 2, 8  # of a robot that walks
SHIPPED_LIMBS = ("LF", "LH", "RH", "RF")  # of the robots known by name
NUMBERS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight")
_ROUNDING = 1e-9
_OF_REGISTERS = ("control.kp", "control.ki", "control.kd")

AnySection = TypeVar("AnySection", bound=BaseModel)


class _ByName(v.Section):
    """A section whose keys are names of the user's, each with a value of one kind."""

    model_config = ConfigDict(frozen=True, extra="allow")

    def __hash__(self) -> int:
        return hash(tuple(self.items()))

    def items(self) -> ItemsView[str, Any]:
        """The names and their values, in the order given."""
        return (self.__pydantic_extra__ or {}).items()


class Kind(_ByName):
    """A component other than the paper's: a shipped one, or one of the user's, with values and options.

    Its class knows the values and options, and checks them.
    """

    model_config = ConfigDict(json_schema_extra=lambda schema, kind: schema["properties"]["kind"].update(kind.others()))
    PLACE: ClassVar[str] = ""  # the section, whose shipped kinds it may name
    PLAIN: ClassVar[str | None] = None  # the paper's kind, which has a section of its own
    __pydantic_extra__: dict[str, v.Given]

    kind: v.OwnName = Field(description="name of a shipped kind, or FILE.py:NAME, beside the config, if relative")
    digest: v.OwnName | None = setting(None, "SHA-256 of file and imports beside it; null: any will do")

    @classmethod
    def others(cls) -> dict[str, Any]:
        """The part of a JSON schema that keeps the paper's kind out."""
        return {} if cls.PLAIN is None else {"not": {"const": cls.PLAIN}}

    @property
    def file(self) -> str | None:
        """The file of Python, None of a shipped kind."""
        return self.kind.rpartition(":")[0] or None

    @property
    def name(self) -> str:
        """The name in the file, or that of a shipped kind."""
        return self.kind.rpartition(":")[2]

    def faults(self) -> Iterator[ValueError]:
        known = shipped_kinds(self.PLACE) if self.PLACE else (self.kind,)
        if self.kind not in known and not (self.file and self.name):
            yield failure(f"one of {', '.join(known)}, or FILE.py:NAME", key="kind", got=self.kind)


def _one_of_kinds(plain: str) -> Discriminator:
    """Tell a section of the paper's kind from one that names another."""

    def tag(value: Any) -> str:
        kind = value.get("kind", plain) if isinstance(value, Mapping) else getattr(value, "kind", plain)
        return PLAIN_TAG if kind == plain else OTHER_TAG

    return Discriminator(tag)


class FootholdsKind(Kind):
    """A choice of footholds with values of its own."""

    PLACE: ClassVar[str] = "gait.footholds"


_RULES = ("planned", *shipped_kinds("gait.footholds"))
AnyFootholds = Annotated[
    Annotated[Literal[_RULES], Tag(PLAIN_TAG)]  # type: ignore[valid-type]
    | Annotated[FootholdsKind, Tag(OTHER_TAG)],
    Discriminator(lambda value: OTHER_TAG if isinstance(value, (Mapping, Kind)) else PLAIN_TAG),
]


class Phases(_ByName):
    """When each limb lifts off, by its name."""

    __pydantic_extra__: dict[str, v.Share]


class SwingFile(v.Section):
    """A swing that others planned, scaled to the stride and the step height."""

    file: v.FileName = Field(
        description="beside the config, if relative: RAMP's matrix of control points (.txt, three rows), or a plan of "
        "ReSTO as a recording of ROS 2 (.db3, .mcap) or PlotJuggler's export of it (.csv)"
    )
    frame: v.Word = setting("planned/limb_2_palm_link", "frame in /tf of the foot that swings")


class Waiting(v.ComponentSection):
    """A gait that lifts no limb while another that should hold does not."""

    COMPONENT = declared.Waiting

    waits: bool | None = setting(
        None,
        "whether the gait waits for grips; null: where the ground has holds, or grips may fail, as those of "
        "contact.kind: uncertain",
    )


class Gait(v.ComponentSection):
    """Periodic gait: which limbs swing when, how far and how high."""

    COMPONENT = declared.PeriodicGait

    sequence: v.Swings = setting(
        ("LH", "LF", "RH", "RF"),
        "order in which the limbs swing, evenly over the cycle; limbs that swing together are a list in it",
    )
    phases: Phases | None = setting(None, "share of the cycle at which each limb lifts off, 1; null: by the sequence")
    swing: Literal["cubic", "low_reaction"] = setting(
        "cubic", "path of a swinging foot: cubics, or the one near them that disturbs the base least"
    )
    swing_file: SwingFile | None = setting(None, "a published swing in place of the cubics; null: none")
    base_reference: Literal["nominal", "actual"] = setting(
        "nominal", "where each cycle's base reference starts: where planned, or where the base is"
    )
    footholds: AnyFootholds = setting(
        "planned",
        "footholds of the periodic gait, or the rule that chooses among the points that can be held: "
        f"{', '.join(_RULES)}, or a mapping with kind and values",
    )
    order: Literal["periodic", "free"] = setting(
        "periodic", "order of the limbs: by the sequence, or the limb next that gains most, one at a time"
    )
    way_points: v.Pairs = setting(
        (), "x and y of points that the base walks to, one after the other, m; with chosen footholds; none: by heading"
    )
    waiting: Waiting = setting(Waiting(), "whether the gait waits for feet that do not hold, and what they try")
    planning_period: v.Positive = setting(
        0.02,
        "time between two choices of footholds or looks for danger, s; rounded to time steps that divide the duration",
    )

    def faults(self) -> Iterator[ValueError]:
        if self.swing == "low_reaction" and self.swing_file is not None:
            yield failure("none with swing: low_reaction", key="swing_file", got=self.swing_file.file)
        for key, plain in (("height", 1.0), ("sway", 0.0), ("landing_speed", 0.0)):
            if self.swing == "low_reaction" and (value := getattr(self, key)) != plain:
                yield failure(f"{plain:g} with swing: low_reaction, which is computed for that", key=key, got=value)

    @property
    def places(self) -> list[tuple[str, ...]]:
        """The limbs that swing together, in the order of the sequence."""
        return [(place,) if isinstance(place, str) else place for place in self.sequence]

    @property
    def lift_off(self) -> dict[str, float]:
        """Share of the cycle at which each limb lifts off, 1, by its name."""
        if self.phases is not None:
            return dict(self.phases.items())
        return {limb: n / len(self.places) for n, place in enumerate(self.places) for limb in place}


class Footholds(_ByName):
    """Heights of each limb's footholds, m, in the order of use, the first included; the last one stays.

    By the limb's name; a limb that is not named has all of them at zero.
    """

    __pydantic_extra__: dict[str, v.Heights]


class HeightMap(v.Section):
    """Heights on a grid: rows along y, columns along x; a PNG's top row is its far side, the largest y."""

    file: v.FileName = Field(description="grid, .csv, .npy or .png (grey, 0 to 1); beside the config, if relative")
    resolution: v.Positive = Field(description="distance between neighbouring samples, m")
    origin: v.Pair = setting((-0.5, -0.5), "x and y of the sample with the smallest x and y, m")
    scale: v.Number = setting(1.0, "height of one unit of the file, m")


class Hold(v.Section):
    """A point that can be held."""

    at: v.Vector = Field(description="where it is, m")
    normal: v.Vector = setting((0.0, 0.0, 1.0), "direction out of the ground, of any length above 0, 1")
    limit: v.Limit = setting(None, "its holding limit, N; null: that of all points")

    def faults(self) -> Iterator[ValueError]:
        if not any(self.normal):
            yield failure("a direction, not zero", key="normal", got=self.normal)


class HoldCloud(v.Section):
    """Points from a file."""

    file: v.FileName = Field(
        description="points, beside the config, if relative: .csv with a header, .ply, .pcd, ClimbLab's .mat, or a "
        "recording of ROS 2, .mcap or .db3"
    )
    topic: v.Word | None = setting(None, "topic of a recording with sensor_msgs/PointCloud2; null: the only one")
    limit: v.Word | None = setting(None, "name of the column with holding limits; null: limit, if the file has it")
    limit_unit: v.Positive = setting(1.0, "holding limit for a 1 in that column, N")
    neighbours: v.Count = setting(
        1,
        "nearest points to which a plane is fitted for normals that the file lacks, towards a PCD's viewpoint or up; "
        "below 3: they are up",
    )


class HoldMap(HeightMap):
    """A height map whose samples can be held, but for those that are not a number."""

    mask: v.FileName | None = setting(
        None, "grid of the same shape, above 0 where the ground can be held; null: everywhere"
    )


class _Area(v.Section):
    """A rectangle of the ground."""

    corner: v.Pair = setting((-0.5, -0.5), "corner with the smallest x and y, m")
    size: v.Sides = setting((2.5, 1.0), "sides along x and y, m")


class Handrails(_Area):
    """Rails along x, as far apart as the area allows, at height zero."""

    rails: v.Count = setting(2, "number of rails over the area's width")
    pitch: v.Positive = setting(0.05, "distance of points along a rail, m")


class Truss(_Area):
    """A lattice of square bays with diagonals; a box of four faces where it has a depth."""

    bay: v.Positive = setting(0.25, "side of a bay, m")
    depth: v.NonNegative = setting(0.0, "depth of the box below its upper face, m; 0: one face")
    pitch: v.Positive = setting(0.05, "distance of points along a member, m; at most")


class Pipe(_Area):
    """A pipe along x in the middle of the area, which touches height zero from below."""

    radius: v.Positive = setting(0.5, "radius, m")
    around: v.Count = setting(32, "points around the pipe")
    pitch: v.Positive = setting(0.05, "distance of points along the pipe, m")


class HoldWall(_Area):
    """Climbing holds on a grid, every other row shifted by half a pitch."""

    pitch: v.Positive = setting(0.1, "distance of holds in a row, and of rows, m")
    filled: v.Part = setting(1.0, "share of the places that have a hold, 1")
    height: v.NonNegative = setting(0.0, "largest height of a hold, m")
    tilt: v.NonNegative = setting(0.0, "standard deviation of the tilt of normals about each level axis, rad")


class Rock(_Area):
    """Random points on a rough surface."""

    density: v.Positive = setting(200.0, "points for each square metre, 1/m^2")
    roughness: v.NonNegative = setting(0.01, "standard deviation of heights, m")
    wavelength: v.Positive = setting(0.3, "wavelength of the longest waves of the surface, m")


class HoldPolyhedron(v.Section):
    """Forces that a point holds: A f <= b times its limit, f of the ground on the foot.

    In the point's own axes: z along the normal, x uphill in the surface, or the world's x where gravity has no part in
    it. A pull has f_z below 0.
    """

    matrix: v.Rows = Field(description="rows of A, 1")
    bound: v.Bounds = Field(description="b, a share of the point's limit for each row, 1")

    def faults(self) -> Iterator[ValueError]:
        if len(self.matrix) != len(self.bound):
            yield failure(f"{len(self.matrix)} numbers, one for each row of matrix", key="bound", got=self.bound)


class Holds(v.Section):
    """Points that can be held, from one source, among which `gait.footholds` chooses."""

    points: tuple[Hold, ...] | None = setting(None, "a list of points")
    cloud: HoldCloud | None = setting(None, "a file of points")
    map: HoldMap | None = setting(None, "a height map with a mask")
    handrails: Handrails | None = setting(None, "rails along x")
    truss: Truss | None = setting(None, "a lattice, or a box of lattices")
    pipe: Pipe | None = setting(None, "a pipe along x")
    wall: HoldWall | None = setting(None, "climbing holds on a grid")
    rock: Rock | None = setting(None, "random points on a rough surface")
    limit: v.Limit = setting(
        None, "holding limit of points that have none of their own, N; null: the contact's limit alone"
    )
    spread: v.NonNegative = setting(0.0, "standard deviation of the natural logarithm of limits, drawn by the seed, 1")
    polyhedron: HoldPolyhedron | None = setting(
        None, "forces that points hold; null: any that does not pull along the normal by more than the limit"
    )
    seed: v.Seed = setting(0, "of all that is random in points and limits; equal seeds, equal ground")
    spacing: v.NonNegative = setting(
        0.0, "edge of cubes of which each keeps one point, that with the largest limit, m; 0: all points"
    )
    at: v.Vector = setting((0.0, 0.0, 0.0), "where the source's origin is in the world, m")
    turn: v.Vector = setting((0.0, 0.0, 0.0), "roll, pitch and yaw of the source's axes in the world, rad")
    count: v.Count | None = setting(
        None, "number of points that a walk is compiled for, so that grounds share a program; null: that of the ground"
    )

    @property
    def source(self) -> tuple[str, Any]:
        """The key of the source, and its value."""
        return next((name, each) for name in HOLD_SOURCES if (each := getattr(self, name)) is not None)

    def faults(self) -> Iterator[ValueError]:
        given = [name for name in HOLD_SOURCES if getattr(self, name) is not None]
        if len(given) != 1:
            key = {"key": given[1]} if given else {}
            yield failure(f"one of {', '.join(HOLD_SOURCES)}", **key, got=" and ".join(given) or "none")


HOLD_SOURCES = ("points", "cloud", "map", "handrails", "truss", "pipe", "wall", "rock")


class Ground(v.Section):
    """Uneven ground; flat at height zero, and held everywhere, unless one of these is given."""

    footholds: Footholds | None = setting(None, "a height for each foothold")
    map: HeightMap | None = setting(None, "a height map, read at the planned footholds")
    holds: Holds | None = setting(None, "points that can be held")

    def faults(self) -> Iterator[ValueError]:
        given = [name for name in ("footholds", "map", "holds") if getattr(self, name) is not None]
        if len(given) > 1:
            yield failure(f"{given[0]} or {given[1]}, not both", key=given[1], got=" and ".join(given))


class Contact(v.ComponentSection):
    """Spring-damper between a gripped foot and its grip point."""

    COMPONENT = declared.Gripper

    kind: Literal["gripper"] = setting("gripper", f"{', '.join(shipped_kinds('contact'))}, or FILE.py:NAME")


class ContactKind(Kind):
    """Another contact than the gripper of Eq. 5."""

    PLACE: ClassVar[str] = "contact"
    PLAIN: ClassVar[str | None] = "gripper"


AnyContact = Annotated[
    Annotated[Contact, Tag(PLAIN_TAG)] | Annotated[ContactKind, Tag(OTHER_TAG)], _one_of_kinds("gripper")
]


class Recovery(v.ComponentSection):
    """When the gait is interrupted, and how; a threshold of null never interrupts it, and none does by default."""

    COMPONENT = declared.Recovery

    margin: v.PositiveOrNull = setting(None, "GIA margin below which the gait is interrupted, m/s^2")

    @property
    def interrupts(self) -> bool:
        """Whether there is a threshold."""
        return not self.shift is self.utilization is self.margin is None


class Control(v.ComponentSection):
    """Joint loop and an admittance law around it. Six values: translations x, y, z, then rotations."""

    COMPONENT = declared.JointLoop

    controller: Controller = setting(
        "base_admittance", "pd (gait alone), base_admittance (paper Eq. 3), or end_effector_admittance (Eq. 2)"
    )
    reading: Literal["virtual_model", "measured_pose"] = setting(
        "virtual_model", "form of Eq. 3 in discrete time: own state, or measured base motion"
    )
    inertia: v.Gain = setting(1.0, "virtual inertia M, kg (translations), kg m^2 (rotations)")
    damping: v.Gain = setting(5.0e3, "virtual damping D, N s/m (translations), N m s/rad (rotations)")
    stiffness: v.Gain = setting(5.0e4, "virtual stiffness K, N/m (translations), N m/rad (rotations)")
    safe_kp: v.PositiveOrNull = setting(
        None, "kp of all joints at least, once a law that reads forces has lost a sensor, N m/rad; null: the kp above"
    )
    integration: Literal["exact", "semi_implicit"] = setting(
        "exact", "of the virtual mass: exact, or semi-implicit Euler in substeps of at most 2 ms, as on the robot"
    )
    deadband: v.Threshold = setting(0.0, "forces, moments below it count as zero, N, N m; a number, or one of each")
    max_offset: v.Bound = setting(None, "largest shift by the virtual mass, m, rad; a number, one of each, null: any")
    max_velocity: v.Bound = setting(
        None, "largest rate of the virtual mass, m/s, rad/s; a number, one of each, null: any"
    )
    recovery: Recovery = setting(Recovery(), "thresholds that interrupt the gait, and how it is interrupted")

    def faults(self) -> Iterator[ValueError]:
        if self.controller == "end_effector_admittance" and self.reading != "virtual_model":
            expected = "virtual_model with end_effector_admittance (measured_pose reads base_admittance only)"
            yield failure(expected, key="reading", got=self.reading)
        if self.controller == "base_admittance" and self.reading == "measured_pose":
            plain = Control()
            for key in ("integration", "deadband", "max_offset", "max_velocity"):
                if (value := getattr(self, key)) != getattr(plain, key):
                    yield failure("none with measured_pose, which has no virtual mass", key=key, got=value)


class _Window(v.ComponentSection):
    """A span of time, start <= t < stop."""

    def faults(self) -> Iterator[ValueError]:
        start, stop = self.start, self.stop
        if stop is not None and not start < stop:
            yield failure(f"a time after start = {start:g} s, or null", key="stop", got=stop)


class Cargo(_Window):
    """Point mass that sits at the base's centre of mass for a while."""

    COMPONENT = declared.Cargo


class Push(_Window):
    """Constant wrench on the base for a while."""

    COMPONENT = declared.Push
    REQUIRED = ("force", "start")


class DisturbanceKind(Kind):
    """Another disturbance than cargo and pushes."""

    PLACE: ClassVar[str] = "disturbance.others"


class Disturbance(v.Section):
    """Disturbances of the robot on its way."""

    cargo: Cargo = setting(Cargo(), "cargo on the base")
    pushes: tuple[Push, ...] = setting((), "pushes on the base; they add up where they overlap")
    others: tuple[DisturbanceKind, ...] = setting(
        (), f"what else acts from outside: {', '.join(shipped_kinds('disturbance.others'))}, or FILE.py:NAME"
    )


class DeadFrom(_ByName):
    """From when on the force sensors of some limbs read exactly 0, s, by the limb's name."""

    __pydantic_extra__: dict[str, v.NonNegative]


class ForceSensor(v.ComponentSection):
    """Force sensors of the feet, a sample every time step."""

    COMPONENT = declared.ForceSensors

    source: Literal["sensor", "joint_effort"] = setting(
        "sensor", "a sensor in each foot, or the statics of each limb under its motors' torques, without friction"
    )
    axes: Literal["xyz", "z"] = setting("xyz", "world axes that are measured; others read 0")
    filtered_by: Literal["sensor", "law"] = setting(
        "sensor", "forces of each foot every time step, or the law's own samples of them and of the wrench"
    )
    dead: DeadFrom | None = setting(
        None, "instants from which sensors read exactly 0, s, by the limb's name; null: none does"
    )


class BaseEstimate(v.ComponentSection):
    """Pose and rates of the base as the law knows them; measured_pose and the laws that share forces among feet do."""

    COMPONENT = declared.BaseEstimate


class Registers(v.Section):
    """Gains of the joint loop as the registers of a servo's position loop hold them."""

    p: v.Register = Field(description="Position P Gain, 1 or more")
    i: v.Register = setting(0, "Position I Gain")
    d: v.Register = setting(0, "Position D Gain")

    def faults(self) -> Iterator[ValueError]:
        if self.p == 0:
            yield failure("a register of 1 or more, as control.kp is above 0", key="p", got=0)


class Servo(v.ComponentSection):
    """The joints' motors and gears, all alike."""

    COMPONENT = declared.Servos

    kind: Literal["servo"] = setting("servo", f"{', '.join(shipped_kinds('hardware.servo'))}, or FILE.py:NAME")
    drive: Literal["torque", "voltage"] = setting(
        "torque",
        "what the joint loop asks for: a torque, given up to the torque-speed line, or a share of the supply voltage, "
        "of which the motor's speed takes its part (back EMF)",
    )
    registers: Registers | None = setting(
        None, "P, I, D registers of the position loop, taken in place of control.kp, ki, kd; null: none"
    )
    register_scale: RegisterScale | None = setting(
        None, "what a unit of each register stands for, of this kind of servo; null: not known"
    )

    def faults(self) -> Iterator[ValueError]:
        if self.no_load_speed is not None and self.torque_limit is None:
            yield failure("a number beside no_load_speed", key="torque_limit", got=None)
        for key in ("torque_limit", "no_load_speed") if self.drive == "voltage" else ():
            if getattr(self, key) is None:
                yield failure("a number with drive: voltage", key=key, got=None)
        for key, other in (
            ("torque_limit", "registers"),
            ("rated_voltage", "supply_voltage"),
            ("torque_limit", "supply_voltage"),
            ("profile_velocity", "profile_acceleration"),
        ):
            if getattr(self, key) is None and getattr(self, other) is not None:
                yield failure(f"a number beside {other}", key=key, got=None)
        if self.supply_resistance and (self.drive == "torque" or self.supply_voltage is None):
            expected = "0 but with drive: voltage and a supply_voltage"
            yield failure(expected, key="supply_resistance", got=self.supply_resistance)
        if self.drive == "torque" and self.pwm_limit != 1:
            yield failure(
                "1 with drive: torque, which has no share of the voltage", key="pwm_limit", got=self.pwm_limit
            )
        if self.registers is not None:
            self._check_registers(self.registers)

    def _check_registers(self, held: Registers) -> None:
        """Refuse registers without a scale, and those that are larger than the servo's."""
        if (scale := self.register_scale) is None:
            expected = "the scale of this servo's registers beside registers, as configs/hardware/mx_64.yaml has one"
            raise failure(expected, key="register_scale", got=None)
        for name in ("p", "i", "d"):
            value = getattr(held, name)
            if value and getattr(scale, name) is None:
                raise failure(f"a number beside registers.{name}", key=f"register_scale.{name}", got=None)
            if value > scale.largest:
                expected = f"a whole number from 0 to {scale.largest}, as register_scale.largest says"
                raise failure(expected, key=f"registers.{name}", got=value)


class DriveKind(Kind):
    """Another actuator than servos."""

    PLACE: ClassVar[str] = "hardware.servo"
    PLAIN: ClassVar[str | None] = "servo"


AnyServo = Annotated[Annotated[Servo, Tag(PLAIN_TAG)] | Annotated[DriveKind, Tag(OTHER_TAG)], _one_of_kinds("servo")]


class Hardware(v.ComponentSection):
    """The hardware between control law and joints; all zero or null: none."""

    COMPONENT = declared.Bus

    interpolation: Literal["hold", "linear"] = setting(
        "hold", "joint targets between two periods: held, or on a line to the next"
    )
    force_sensor: ForceSensor = setting(ForceSensor(), "force sensors of the feet")
    base_estimate: BaseEstimate = setting(BaseEstimate(), "what the law knows of the base")
    servo: AnyServo = setting(Servo(), "motors and gears")


class Limb(v.Section):
    """One limb of a robot from a file."""

    joints: v.JointNames = Field(description="names of its joints, two to seven, from the base outwards")
    foot: v.Word | None = setting(None, "name of the site, body or link that is the foot; null: none, on a stand")
    at: v.Vector = setting((0.0, 0.0, 0.0), "where on it the foot is, in its own frame, m")
    foothold: v.Pair | None = setting(
        None, "where the foot stands in the rest stance: x ahead, y left, base link's frame, m; null: on a stand"
    )


class Limbs(_ByName):
    """The limbs of a robot from a file, two to eight, or one on a stand, by names of the user's choice."""

    model_config = ConfigDict(json_schema_extra={"minProperties": 1, "maxProperties": MAX_LIMBS})
    __pydantic_extra__: dict[str, Limb]


class Locked(_ByName):
    """Joints of a robot's file that are held for good: their names and values, rad or m."""

    __pydantic_extra__: dict[str, v.Number]


class Spring(v.Section):
    """A joint that nothing drives."""

    stiffness: v.NonNegative = Field(description="stiffness, N m/rad, or N/m of a sliding joint")
    damping: v.NonNegative = setting(0.0, "damping beside the file's, N m s/rad, or N s/m")
    rest: v.Number = setting(0.0, "where the spring is slack, rad, or m")


class Springs(_ByName):
    """Joints of limbs that nothing drives, by their names."""

    __pydantic_extra__: dict[str, Spring]


class RobotFile(v.Section):
    """A robot of your own; its base link's axes are x ahead, y left, z up."""

    file: v.FileName = Field(description="MJCF (.xml) or URDF (.urdf); beside the config, if the path is relative")
    height: v.Positive | None = setting(
        None,
        "height of the base link's frame over the ground in the rest stance, m; null: the base is held on a stand, "
        "joints rest at 0, and nothing walks",
    )
    base: v.Word | None = setting(
        None, "body that the limbs begin at, where the file's root is a foot; null: as in the file"
    )
    limbs: Limbs = Field(description="joints and feet")
    locked: Locked = setting(Locked(), "joints of the file that belong to no limb, held at a value")
    springs: Springs = setting(Springs(), "joints of limbs that nothing drives, each on a spring")

    @property
    def in_order(self) -> dict[str, Limb]:
        """The limbs counter-clockwise from straight ahead, as the stability margins need them; on a stand as named."""
        at = {name: limb.foothold or (0.0, 0.0) for name, limb in self.limbs.items()}
        return dict(sorted(self.limbs.items(), key=lambda item: math.atan2(*at[item[0]][::-1]) % (2 * math.pi)))

    @property
    def on_stand(self) -> bool:
        """Whether the base is held, and nothing walks."""
        return self.height is None

    def faults(self) -> Iterator[ValueError]:
        limbs = dict(self.limbs.items())
        least = 1 if self.on_stand else MIN_LIMBS
        if not least <= len(limbs) <= MAX_LIMBS:
            yield failure(f"{least} to {MAX_LIMBS} limbs", key="limbs", got=len(limbs))
        for name, limb in limbs.items() if not self.on_stand else ():
            for key in ("foot", "foothold"):
                if getattr(limb, key) is None:
                    yield failure("a value, as the robot has a height", key=f"limbs.{name}.{key}", got=None)
            if len(limb.joints) < 2:
                yield failure("two joints or more of a limb that walks", key=f"limbs.{name}.joints", got=limb.joints)


AnyRobot = Annotated[
    Annotated[v.Name, Tag(PLAIN_TAG)] | Annotated[RobotFile, Tag(OTHER_TAG)],
    Discriminator(lambda value: OTHER_TAG if isinstance(value, (Mapping, RobotFile)) else PLAIN_TAG),
]


class OwnObject(v.Section):
    """An object in a file of the user's, named as FILE.py:NAME by options."""

    file: v.FileName | None = setting(
        None, "file of Python, beside the config, if relative; null: it was defined in a session"
    )
    name: v.OwnName = Field(description="its name in the file")
    digest: v.OwnName | None = setting(None, "SHA-256 of file and imports beside it; null: any will do")


class OwnGains(_ByName):
    """Gains by the names that a law of your own gives them."""

    __pydantic_extra__: dict[str, v.Values]


class OwnLimits(_ByName):
    """Limits by the names that a law of your own gives them; a limit is not a gain and is not searched."""

    __pydantic_extra__: dict[str, v.Positive]


class OwnLaw(OwnObject):
    """A control law of your own, in place of the control section's."""

    gains: OwnGains = setting(OwnGains(), "in place of its own, SI units")
    limits: OwnLimits = setting(OwnLimits(), "in place of its own, SI units; a walk is compiled for them")


class Own(v.Section):
    """Law, metrics, objective and method beside those that come with the program."""

    law: OwnLaw | None = setting(None, "control law in place of the control section's")
    metrics: tuple[OwnObject, ...] = setting((), "metrics beside the shipped ones")
    objective: OwnObject | None = setting(None, "objective of a search from Python")
    method: OwnObject | None = setting(None, "method of a search whose settings say own")

    @model_validator(mode="before")
    @classmethod
    def _components_have_sections(cls, data: object) -> object:
        """Say where the components of an older config stand now."""
        if not isinstance(data, Mapping):
            return data
        for key, section in _MOVED.items():
            if old := data.get(key):
                raise failure(f"{section}, with kind and values side by side", key=key, got=old)
        return {key: value for key, value in data.items() if key not in _MOVED}


_MOVED = {
    "contact": "the section contact",
    "drive": "the section hardware.servo",
    "disturbances": "disturbance.others",
    "footholds": "gait.footholds",
}


class Scenario(v.Section):
    """One walk of one robot, fully specified. Immutable and hashable."""

    robot: AnyRobot = setting("hubrobo_v3_2", "name of the robot, or your own from a file")
    gravity: v.Gravity = setting((0.0, 0.0, -v.G), "gravity, world axes, m/s^2; a slope tilts it")
    duration: v.Positive = setting(8.0, "length of the walk, s; a whole number of time steps")
    time_step: v.Positive = setting(0.001, "time step of the simulation, s")
    gait: Gait = setting(Gait(), "how the limbs move")
    ground: Ground = setting(Ground(), "heights of the footholds")
    contact: AnyContact = setting(Contact(), "how the grippers hold the ground")
    control: Control = setting(Control(), "controller and gains")
    disturbance: Disturbance = setting(Disturbance(), "cargo and pushes")
    hardware: Hardware = setting(Hardware(), "sensors, rate, bus and servos; ideal ones by default")
    own: Own | None = setting(None, "law, metrics, objective and method of your own: files are run")

    if TYPE_CHECKING:  # the keywords, for type checkers: pydantic takes the values of YAML too

        def __init__(
            self, *, robot: Any = ..., gravity: Any = ..., duration: float = ..., time_step: float = ...,
            gait: Any = ..., ground: Any = ..., contact: Any = ..., control: Any = ..., disturbance: Any = ...,
            hardware: Any = ..., own: Any = ...,
        ) -> None: ...  # fmt: skip

    @model_validator(mode="after")
    def _gains_of_registers(self) -> Scenario:
        held, scale, stall_torque = (
            self.value(f"hardware.servo.{key}") for key in ("registers", "register_scale", "torque_limit")
        )
        if held is not None and scale is not None and stall_torque is not None:
            found = registers.gains_of(registers.Registers(held.p, held.i, held.d), scale, stall_torque)._asdict()
            self.__dict__["control"] = self.control.model_copy(update=found)  # frozen, but not read by anyone yet
        return self

    def faults(self) -> Iterator[ValueError]:
        yield from self._broken_steps()
        yield from self._wrong_limbs()

    def _broken_steps(self) -> Iterator[ValueError]:
        hardware, step = self.hardware, f"time steps of {self.time_step:g} s"
        spans = {"duration": self.duration, "gait.cycle": self.gait.cycle}
        for key, span in {**spans, "hardware.control_period": hardware.control_period}.items():
            steps, none = span / self.time_step, "" if key in spans else ", or 0"
            if steps > MAX_STEPS:
                yield failure(f"at most {MAX_STEPS} {step}", key=key, got=span)
            if (not none and round(steps) < 1) or not math.isclose(steps, round(steps), rel_tol=1e-9, abs_tol=1e-9):
                yield failure(f"a whole number of {step}{none}", key=key, got=span)
        if (rate := self.value("hardware.servo.rate")) is not None:
            steps = 1 / (rate * self.time_step)
            if round(steps) < 1 or not math.isclose(steps, round(steps), rel_tol=1e-9):
                yield failure(f"a rate whose period is a whole number of {step}", key="hardware.servo.rate", got=rate)
        for key in ("command_delay", "force_sensor.delay", "base_estimate.delay", "servo.delay"):
            if (delay := self.value(f"hardware.{key}", 0.0)) / self.time_step > MAX_DELAY:
                yield failure(f"at most {MAX_DELAY} {step}", key=f"hardware.{key}", got=delay)
        if int((1 - self.gait.duty) * self.gait.cycle / self.time_step + 1e-6) < 2:
            yield failure(f"a swing, (1 - duty) cycle, of two {step} or more", key="gait.duty", got=self.gait.duty)

    def _wrong_limbs(self) -> Iterator[ValueError]:
        if isinstance(self.robot, RobotFile) and self.robot.on_stand:
            return
        gait, limbs = self.gait, SHIPPED_LIMBS if isinstance(self.robot, str) else tuple(dict(self.robot.limbs.items()))
        known = f"the {NUMBERS[len(limbs)]} limbs {', '.join(limbs)}"
        swings = list(gait.lift_off) if gait.phases is not None else [limb for place in gait.places for limb in place]
        if sorted(swings) != sorted(limbs):
            if gait.phases is None:
                yield failure(f"{known}, each once, in any order", key="gait.sequence", got=gait.sequence)
            yield failure(f"a phase for each of {known}", key="gait.phases", got=gait.lift_off)
        by_limb = {
            "ground.footholds": self.ground.footholds,
            "hardware.force_sensor.dead": self.hardware.force_sensor.dead,
        }
        for key, values in by_limb.items():
            for name in dict(values.items()) if values is not None else ():
                if name not in limbs:
                    yield failure(f"one of the limbs {', '.join(limbs)}", key=f"{key}.{name}", got=name)
        # one limb stands at any time
        least, swing = 1 - 1 / len(gait.sequence), 1 - gait.duty
        if gait.phases is None and gait.duty < least - _ROUNDING:
            expected = f"a number from {least:g} to below 1, so that one swing ends as the next begins"
            yield failure(expected, key="gait.duty", got=gait.duty)
        for limb, phase in gait.lift_off.items() if gait.phases is not None else ():
            if phase + swing > 1 + _ROUNDING:
                expected = f"a swing that ends within the cycle, phase {gait.duty:g} or less"
                yield failure(expected, key=f"gait.phases.{limb}", got=phase)
            if all(other <= phase < other + swing - _ROUNDING for other in gait.lift_off.values()):
                yield failure("a limb on the ground at every moment", key=f"gait.phases.{limb}", got=phase)

    @property
    def limbs(self) -> tuple[str, ...]:
        """The names of the robot's limbs, in its order."""
        return SHIPPED_LIMBS if isinstance(self.robot, str) else tuple(self.robot.in_order)

    def value(self, key: str, default: Any = None) -> Any:
        """The value at a dotted key; `default` where the section's component has no such field, or names none."""
        try:
            return operator.attrgetter(key)(self)
        except AttributeError:
            return default

    @property
    def steps(self) -> int:
        """Number of time steps of the walk."""
        return round(self.duration / self.time_step)

    @property
    def planning_steps(self) -> int:
        """Number of time steps of a planning period: the nearest number that divides the walk."""
        wanted = min(max(1.0, self.gait.planning_period / self.time_step), self.steps)
        low, high = (
            next(n for n in range(start, stop, way) if self.steps % n == 0)
            for start, stop, way in ((math.floor(wanted), 0, -1), (math.ceil(wanted), self.steps + 1, 1))
        )
        return low if wanted - low <= high - wanted else high

    def plain(self) -> dict[str, Any]:
        """The resolved scenario as plain values, those of `to_yaml`."""
        return {key: value for key, value in self.model_dump(mode="json").items() if key != "own" or value}

    def to_yaml(self) -> str:
        """The resolved scenario as YAML; loading it gives an equal scenario."""
        return yaml.dump(self.plain(), Dumper=Dumper, sort_keys=False, default_flow_style=None, width=110)

    @classmethod
    def from_yaml(cls, text: str, source: str = "scenario") -> Scenario:
        """The scenario in a YAML text, as `to_yaml` writes it; `source` names it in the `ConfigError` of a bad one."""
        return validated(cls, parse(text, source), source)

    def with_own(self, **changes: object) -> Scenario:
        """A copy with some keys of the section `own` changed; without the section where it names nothing then."""
        own = {**({} if self.own is None else self.own.model_dump(mode="json")), **changes}
        place = {"own": own} if any(own.values()) else {"own": None}
        return validated(Scenario, self.model_dump(mode="json") | place, "scenario")

    def with_files(self, change: Callable[[str, str], str]) -> Scenario:
        """A copy with the paths in it changed; `change` is given a dotted key and its path."""
        holds = self.ground.holds
        named: dict[str, object] = {"robot": self.robot, "ground.map": self.ground.map}
        named["gait.swing_file"] = self.gait.swing_file
        if holds is not None:
            named |= {"ground.holds.cloud": holds.cloud, "ground.holds.map": holds.map}
        if self.own is not None:
            named |= {f"own.{key}": getattr(self.own, key) for key in ("law", "objective", "method")}
            named |= {f"own.metrics.{n}": metric for n, metric in enumerate(self.own.metrics)}
        keys = ("file", "mask")
        files = {f"{place}.{key}": getattr(section, key, None) for place, section in named.items() for key in keys}
        changed = {key: change(key, file) for key, file in files.items() if file is not None}
        for place, each in self.kinds.items():
            if each.file is not None:
                changed[f"{place}.kind"] = f"{change(f'{place}.kind', each.file)}:{each.name}"
        return self.with_overrides(changed)

    @property
    def kinds(self) -> dict[str, Kind]:
        """The components other than the paper's, by their sections: "contact", "disturbance.others.0"."""
        found = {"contact": self.contact, "hardware.servo": self.hardware.servo, "gait.footholds": self.gait.footholds}
        others = {f"disturbance.others.{n}": each for n, each in enumerate(self.disturbance.others)}
        return {place: each for place, each in {**found, **others}.items() if isinstance(each, Kind)}

    def without_kinds(self) -> Scenario:
        """A copy with the paper's components alone."""
        changes: dict[str, object] = {f"{place}.kind": each.PLAIN for place, each in self.kinds.items() if each.PLAIN}
        if isinstance(self.gait.footholds, Kind):
            changes["gait.footholds"] = "planned"
        return self.with_overrides(changes | {"disturbance.others": []})

    def relative_to(self, folder: str | os.PathLike[str]) -> Scenario:
        """A copy with paths of files inside a folder relative to it."""
        folder = Path(folder).absolute()
        return self.with_files(
            lambda _, file: Path(file).relative_to(folder).as_posix() if Path(file).is_relative_to(folder) else file
        )

    def beside(self, folder: str | os.PathLike[str]) -> Scenario:
        """A copy whose relative paths start at a folder, the reverse of `relative_to`."""
        return self.with_files(lambda _, file: str(Path(folder).absolute() / file))

    def with_overrides(self, overrides: Sequence[str] | Mapping[str, object]) -> Scenario:
        """A revalidated copy with some keys changed; `overrides` as in `load_scenario`."""
        return overridden(self, overrides, "scenario")


def validated(kind: type[AnySection], data: object, source: str) -> AnySection:
    """Return the model of plain data.

    Raises:
        ConfigError: in one line, `source`, key, expected and got.
    """
    try:
        return kind.model_validate(data)
    except ValidationError as invalid:
        raise refusal(invalid, kind, source) from None


def overridden(scenario: Scenario, overrides: Sequence[str] | Mapping[str, object], source: str) -> Scenario:
    """Return a scenario with some keys changed; `overrides` as `load_scenario` takes them.

    Raises:
        ConfigError: an override of another form, of a place that is not there, or with a bad value.
    """
    if not overrides:
        return scenario
    data = scenario.model_dump(mode="json")
    try:
        # another kind has other keys: those set beside it come after it
        for key, value in sorted(pairs(overrides, source), key=lambda pair: not str(pair[0]).endswith(".kind")):
            _set_kind(data, key, value, source) if str(key).endswith(".kind") else assign(data, key, value, source)
            held = "hardware.servo.registers"
            if key in _OF_REGISTERS and _section_of(data, held).get("registers") is not None:  # the last one set holds
                assign(data, held, None, source)
    except RecursionError:
        raise ConfigError(source, "", "overrides of a few levels", "endless nesting") from None
    return validated(Scenario, data, source)


def _section_of(data: object, key: str) -> dict[str, object]:
    """Return the section that a key is in, an empty one where there is none."""
    for part in key.split(".")[:-1]:
        by_key = {str(n): each for n, each in enumerate(data)} if isinstance(data, list) else data
        data = by_key.get(part) if isinstance(by_key, dict) else None
    return data if isinstance(data, dict) else {}


def _set_kind(data: dict[str, object], key: str, value: object, source: str) -> None:
    """Set the kind of a section; another kind than before starts with values of its own."""
    section = _section_of(data, key)
    before = section.get("kind")
    if isinstance(before, str) and before.rpartition(":")[2] != str(value).rpartition(":")[2]:
        section.clear()
    assign(data, key, value, source)
