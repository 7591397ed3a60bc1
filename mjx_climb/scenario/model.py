"""The scenario: what walks where, under which controller and disturbance, key by key as in its YAML."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, ItemsView, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, ValidationError, model_validator

from mjx_climb.scenario import registers
from mjx_climb.scenario import values as v
from mjx_climb.scenario.messages import config_error, failure, refusal
from mjx_climb.scenario.registers import RegisterScale
from mjx_climb.scenario.values import setting
from mjx_climb.scenario.yaml_text import Dumper, assign, pairs, parse

MAX_STEPS = 10_000_000
MAX_DELAY = 500  # time steps: each is a sample of a buffer, which a step reads whole
MIN_LIMBS, MAX_LIMBS = 2, 8
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
        """The names and their values, in the order in which they were given."""
        return (self.__pydantic_extra__ or {}).items()


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


class Gait(v.Section):
    """Periodic gait: which limbs swing when, how far and how high."""

    cycle: v.Positive = setting(4.0, "period of the gait, s; a whole number of time steps")
    duty: v.Duty = setting(0.75, "share of the cycle that each limb is gripped, 1")
    stride: v.Way = setting(0.05, "way of the base per cycle, m")
    step_height: v.Height = setting(0.03, "height of a swing foot's arc over the ground, m")
    settling: v.Share = setting(
        0.0, "share of a swing, at its end, in which the foot waits over its new foothold for the gripper to shut, 1"
    )
    height: v.Height = setting(1.0, "height of the base over its feet, as a share of that in the rest stance, 1")
    sway: v.Share = setting(
        0.0, "share of the way to the centroid of the other feet that the base sways in the middle of each swing, 1"
    )
    landing_speed: v.NonNegative = setting(0.0, "speed along the ground's normal at which a swing ends, m/s")
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
    heading: v.Angle = setting(0.0, "direction of walking and initial yaw about world z, rad")
    footholds: Literal["planned", "nearest", "farthest", "climblab", "best_margin", "least_use"] = setting(
        "planned", "footholds of the periodic gait, or the rule that chooses among the points that can be held"
    )
    order: Literal["periodic", "free"] = setting(
        "periodic", "order of the limbs: by the sequence, or the limb next that gains most, one at a time"
    )
    way_points: v.Pairs = setting(
        (), "x and y of points that the base walks to, one after the other, m; with chosen footholds; none: by heading"
    )
    planning_period: v.Positive = setting(
        0.02,
        "time between two choices of footholds or looks for danger, s; rounded to time steps that divide the duration",
    )

    @model_validator(mode="after")
    def _low_reaction_is_of_the_plain_way(self) -> Gait:
        if self.swing == "low_reaction" and self.swing_file is not None:
            raise failure("none with swing: low_reaction", key="swing_file", got=self.swing_file.file)
        for key, plain in (("height", 1.0), ("sway", 0.0), ("landing_speed", 0.0)):
            if self.swing == "low_reaction" and (value := getattr(self, key)) != plain:
                raise failure(f"{plain:g} with swing: low_reaction, which is computed for that", key=key, got=value)
        return self

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
    """Heights of each limb's footholds, m, in the order in which it uses them, the first included; the last one stays.

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

    @model_validator(mode="after")
    def _has_a_direction(self) -> Hold:
        if not any(self.normal):
            raise failure("a direction, not zero", key="normal", got=self.normal)
        return self


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
    """Climbing holds on a grid in which every other row is shifted by half a pitch."""

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

    @model_validator(mode="after")
    def _fit(self) -> HoldPolyhedron:
        if len(self.matrix) != len(self.bound):
            raise failure(f"{len(self.matrix)} numbers, one for each row of matrix", key="bound", got=self.bound)
        return self


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

    @model_validator(mode="after")
    def _one_source(self) -> Holds:
        given = [name for name in HOLD_SOURCES if getattr(self, name) is not None]
        if len(given) != 1:
            key = {"key": given[1]} if given else {}
            raise failure(f"one of {', '.join(HOLD_SOURCES)}", **key, got=" and ".join(given) or "none")
        return self


HOLD_SOURCES = ("points", "cloud", "map", "handrails", "truss", "pipe", "wall", "rock")


class Ground(v.Section):
    """Uneven ground; flat at height zero, and held everywhere, unless one of these is given."""

    footholds: Footholds | None = setting(None, "a height for each foothold")
    map: HeightMap | None = setting(None, "a height map, read at the planned footholds")
    holds: Holds | None = setting(None, "points that can be held")

    @model_validator(mode="after")
    def _one_of_them(self) -> Ground:
        given = [name for name in ("footholds", "map", "holds") if getattr(self, name) is not None]
        if len(given) > 1:
            raise failure(f"{given[0]} or {given[1]}, not both", key=given[1], got=" and ".join(given))
        return self


class Contact(v.Section):
    """Spring-damper between a gripped foot and its grip point."""

    # k_s, d_s and the holding limit of the paper (Eq. 5), with ClimbLab's rule for letting go
    stiffness: v.Positive = setting(1.0e4, "contact stiffness per axis, N/m")
    damping: v.NonNegative = setting(20.0, "contact damping per axis, N s/m")
    rotational_stiffness: v.NonNegative = setting(
        0.0, "stiffness of a grip against turning, N m/rad; 0: a foot is held as a point"
    )
    rotational_damping: v.NonNegative = setting(
        0.0, "damping of a grip against turning, N m s/rad; felt with a rotational_stiffness"
    )
    holding_limit: v.Limit = setting(15.0, "force above which a pulled gripper lets go, N; null: grippers never let go")
    capture_distance: v.Limit = setting(
        None, "how far off the ground a foot may be for its shutting gripper to hold, m; null: any distance"
    )
    closing_time: v.NonNegative = setting(
        0.0, "time in which a gripper that shuts off the ground closes two thirds of the gap, s; 0: at once"
    )
    closing_force: v.PositiveOrNull = setting(None, "pull at which a closing gripper stalls, N; null: none")


class Recovery(v.Section):
    """When the gait is interrupted, and how; a threshold of null never interrupts it, and none does by default."""

    shift: v.PositiveOrNull = setting(None, "shift of the base from its reference that interrupts the gait, m")
    utilization: v.PositiveOrNull = setting(None, "predicted pull of a grip, over its holding limit, that does, 1")
    margin: v.PositiveOrNull = setting(None, "GIA margin below which the gait is interrupted, m/s^2")
    lead_time: v.NonNegative = setting(0.02, "time ahead for which the pull of a grip is predicted, s")
    landing_time: v.Positive = setting(0.25, "time in which a limb in the air comes down, s")
    rest_time: v.NonNegative = setting(1.2, "time for which the gait then stands still, s")
    take_over: v.Part = setting(0.3, "share of the base's shift that its reference takes over, 1")
    return_time: v.Positive = setting(1.0, "time in which the base reference goes back to its path, s")
    reach: v.NonNegative = setting(0.03, "how far beside itself a foot may land on ground that is all held, m")

    @property
    def interrupts(self) -> bool:
        """Whether there is a threshold."""
        return not self.shift is self.utilization is self.margin is None


class Control(v.Section):
    """Joint loop and an admittance law around it. Six values: translations x, y, z, then rotations."""

    controller: Literal["pd", "base_admittance", "end_effector_admittance"] = setting(
        "base_admittance", "pd (gait alone), base_admittance (paper Eq. 3), or end_effector_admittance (Eq. 2)"
    )
    reading: Literal["virtual_model", "measured_pose"] = setting(
        "virtual_model", "form of Eq. 3 in discrete time: own state, or measured base motion"
    )
    inertia: v.Gain = setting(1.0, "virtual inertia M, kg (translations), kg m^2 (rotations)")
    damping: v.Gain = setting(5.0e3, "virtual damping D, N s/m (translations), N m s/rad (rotations)")
    stiffness: v.Gain = setting(5.0e4, "virtual stiffness K, N/m (translations), N m/rad (rotations)")
    # the paper's pd: docs/studies/paper.md tells how far softer joints alone would go
    kp: v.Positive = setting(50.0, "proportional gain of the joint loop, N m/rad")
    kd: v.NonNegative = setting(0.2, "derivative gain of the joint loop, N m s/rad")
    ki: v.NonNegative = setting(0.0, "integral gain of the joint loop, N m/(rad s); 0: no integral term")
    safe_kp: v.PositiveOrNull = setting(
        None,
        "kp of all joints at least, once a law that reads forces has lost a sensor, N m/rad; null: the kp above",
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

    @model_validator(mode="after")
    def _reading_fits(self) -> Control:
        if self.controller == "end_effector_admittance" and self.reading != "virtual_model":
            expected = "virtual_model with end_effector_admittance (measured_pose reads base_admittance only)"
            raise failure(expected, key="reading", got=self.reading)
        if self.controller == "base_admittance" and self.reading == "measured_pose":
            plain = Control()
            for key in ("integration", "deadband", "max_offset", "max_velocity"):
                if (value := getattr(self, key)) != getattr(plain, key):
                    raise failure("none with measured_pose, which has no virtual mass", key=key, got=value)
        return self


class _Window(v.Section):
    """A span of time, start <= t < stop."""

    if TYPE_CHECKING:  # each kind of window has them in its own order
        start: float
        stop: float | None

    @model_validator(mode="after")
    def _in_order(self) -> _Window:
        start, stop = self.start, self.stop
        if stop is not None and not start < stop:
            raise failure(f"a time after start = {start:g} s, or null", key="stop", got=stop)
        return self


class Cargo(_Window):
    """Point mass that sits at the base's centre of mass for a while."""

    mass: v.NonNegative = setting(0.0, "mass, kg; 0: no cargo")
    start: v.NonNegative = setting(2.0, "time of loading, s")
    stop: v.Limit = setting(None, "time of unloading, s; null: stays until the end")


class Push(_Window):
    """Constant wrench on the base for a while."""

    force: v.Vector = Field(description="force on the base, world axes, N")
    moment: v.Vector = setting((0.0, 0.0, 0.0), "moment on the base, world axes, N m")
    start: v.NonNegative = Field(description="first instant, s")
    stop: v.Limit = setting(None, "last instant, s; null: until the end")


class Disturbance(v.Section):
    """What happens to the robot on its way."""

    cargo: Cargo = setting(Cargo(), "cargo on the base")
    pushes: tuple[Push, ...] = setting((), "pushes on the base; they add up where they overlap")


class DeadFrom(_ByName):
    """From when on the force sensors of some limbs read exactly 0, s, by the limb's name."""

    __pydantic_extra__: dict[str, v.NonNegative]


class ForceSensor(v.Section):
    """Force sensors of the feet, a sample every time step."""

    delay: v.NonNegative = setting(0.0, "age of what the law reads, s")
    noise: v.NonNegative = setting(0.0, "white noise, standard deviation per axis and sample, N")
    bias: v.Number = setting(0.0, "offset on every axis of every sensor, world axes, N")
    resolution: v.NonNegative = setting(0.0, "smallest step that the sensor tells, N; 0: any")
    filter: v.PositiveOrNull = setting(None, "first-order low pass, cut-off, Hz; null: none")
    filtered_by: Literal["sensor", "law"] = setting(
        "sensor", "forces of each foot every time step, or the law's own samples of them and of the wrench"
    )
    dead: DeadFrom | None = setting(
        None, "instants from which sensors read exactly 0, s, by the limb's name; null: none does"
    )


class BaseEstimate(v.Section):
    """Pose and rates of the base as the law knows them; measured_pose and the laws that share forces among feet do."""

    delay: v.NonNegative = setting(0.0, "age of pose and rates, s")
    position_noise: v.NonNegative = setting(0.0, "white noise, standard deviation per axis, m")
    velocity_noise: v.NonNegative = setting(0.0, "white noise, standard deviation per axis, m/s")


class Registers(v.Section):
    """Gains of the joint loop as the registers of a servo's position loop hold them."""

    p: v.Register = Field(description="Position P Gain, 1 or more")
    i: v.Register = setting(0, "Position I Gain")
    d: v.Register = setting(0, "Position D Gain")

    @model_validator(mode="after")
    def _holds(self) -> Registers:
        if self.p == 0:
            raise failure("a register of 1 or more, as control.kp is above 0", key="p", got=0)
        return self


class Servo(v.Section):
    """The joints' motors and gears, all alike."""

    drive: Literal["torque", "voltage"] = setting(
        "torque",
        "what the joint loop asks for: a torque, given up to the torque-speed line, or a share of the supply voltage, "
        "of which the motor's speed takes its part (back EMF)",
    )
    rate: v.PositiveOrNull = setting(
        None, "rate of the servo's own loop, Hz; a period is a whole number of time steps; null: every time step"
    )
    registers: Registers | None = setting(
        None, "P, I, D registers of the position loop, taken in place of control.kp, ki, kd; null: none"
    )
    register_scale: RegisterScale | None = setting(
        None, "what a unit of each register stands for, of this kind of servo; null: not known"
    )
    profile_velocity: v.PositiveOrNull = setting(
        None, "speed at which the servo takes its goal to the joint target, rad/s; null: at once"
    )
    profile_acceleration: v.PositiveOrNull = setting(None, "acceleration of that goal, rad/s^2; null: any")
    pwm_limit: v.Part = setting(1.0, "largest share of the supply voltage that a voltage drive gives, 1")
    current_limit: v.PositiveOrNull = setting(
        None, "torque of the motor at the largest current that the servo lets flow, N m; null: any"
    )
    rated_voltage: v.PositiveOrNull = setting(
        None, "voltage of torque_limit, no_load_speed and the loop's gains, V; null: the supply's"
    )
    supply_voltage: v.PositiveOrNull = setting(
        None, "measured voltage, by which torque_limit and no_load_speed scale, V; null: rated_voltage"
    )
    torque_limit: v.PositiveOrNull = setting(None, "torque at standstill, N m; null: any")
    no_load_speed: v.PositiveOrNull = setting(
        None, "speed at which no torque is left, rad/s; null: the torque limit holds at any speed"
    )
    armature: v.NonNegative = setting(0.0, "inertia of motor and gears seen at the joint, kg m^2")
    coulomb_friction: v.NonNegative = setting(0.0, "dry friction, N m")
    presliding: v.Positive = setting(
        5e-4, "how far a joint that dry friction holds gives before it slips, rad; a third of a count of 4096 a turn"
    )
    viscous_friction: v.NonNegative = setting(0.0, "friction that grows with the rate, N m s/rad")
    load_friction: v.NonNegative = setting(0.0, "dry friction as a share of the motor's torque, 1")
    external_load_friction: v.NonNegative = setting(0.0, "dry friction as a share of the load's torque, 1")
    stribeck_friction: v.NonNegative = setting(0.0, "dry friction at standstill beside coulomb_friction, N m")
    stribeck_load_friction: v.NonNegative = setting(0.0, "load_friction at standstill beside that, 1")
    stribeck_external_load_friction: v.NonNegative = setting(0.0, "external_load_friction at standstill beside that, 1")
    quadratic_load_friction: v.NonNegative = setting(
        0.0, "friction at standstill by the motor's torque squared, where the load drives, 1/(N m)"
    )
    quadratic_external_load_friction: v.NonNegative = setting(
        0.0, "friction at standstill by the load's torque squared, where the motor drives, 1/(N m)"
    )
    stribeck_velocity: v.Positive = setting(0.1, "speed by which friction of standstill fell to 37 %, rad/s")
    stribeck_exponent: v.Positive = setting(1.0, "how suddenly it falls there, 1")
    backlash: v.NonNegative = setting(0.0, "play of the gears from end to end, rad")
    delay: v.NonNegative = setting(0.0, "from the joint loop to the motor's torque, s")

    @model_validator(mode="after")
    def _line_has_two_ends(self) -> Servo:
        if self.no_load_speed is not None and self.torque_limit is None:
            raise failure("a number beside no_load_speed", key="torque_limit", got=None)
        for key in ("torque_limit", "no_load_speed") if self.drive == "voltage" else ():
            if getattr(self, key) is None:
                raise failure("a number with drive: voltage", key=key, got=None)
        for key, other in (
            ("torque_limit", "registers"),
            ("rated_voltage", "supply_voltage"),
            ("torque_limit", "supply_voltage"),
            ("profile_velocity", "profile_acceleration"),
        ):
            if getattr(self, key) is None and getattr(self, other) is not None:
                raise failure(f"a number beside {other}", key=key, got=None)
        if self.drive == "torque" and self.pwm_limit != 1:
            raise failure(
                "1 with drive: torque, which has no share of the voltage", key="pwm_limit", got=self.pwm_limit
            )
        if self.registers is not None:
            self._check_registers(self.registers)
        return self

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


class Hardware(v.Section):
    """What stands between the control law and the joints; all zero or null: nothing."""

    control_period: v.NonNegative = setting(
        0.0, "period of law and joint targets, s; a whole number of time steps; 0: the time step"
    )
    command_delay: v.NonNegative = setting(0.0, "from the law to the joints, s")
    interpolation: Literal["hold", "linear"] = setting(
        "hold", "joint targets between two periods: held, or on a line to the next"
    )
    force_sensor: ForceSensor = setting(ForceSensor(), "force sensors of the feet")
    base_estimate: BaseEstimate = setting(BaseEstimate(), "what the law knows of the base")
    servo: Servo = setting(Servo(), "motors and gears")
    seed: v.Seed = setting(0, "of all noise; equal seeds, equal noise")


class Limb(v.Section):
    """One limb of a robot from a file."""

    joints: v.JointNames = Field(description="names of its joints, two to seven, from the base outwards")
    foot: v.Word = Field(description="name of the site, body or link that is the foot")
    at: v.Vector = setting((0.0, 0.0, 0.0), "where on it the foot is, in its own frame, m")
    foothold: v.Pair = Field(
        description="where the foot stands in the rest stance: x ahead, y left, base link's frame, m"
    )


class Limbs(_ByName):
    """The limbs of a robot from a file, two to eight, by names of the user's choice."""

    model_config = ConfigDict(json_schema_extra={"minProperties": MIN_LIMBS, "maxProperties": MAX_LIMBS})
    __pydantic_extra__: dict[str, Limb]

    @model_validator(mode="after")
    def _some(self) -> Limbs:
        if not MIN_LIMBS <= len(self.items()) <= MAX_LIMBS:
            raise failure(f"{MIN_LIMBS} to {MAX_LIMBS} limbs", got=len(self.items()))
        return self


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
    height: v.Positive = Field(description="height of the base link's frame over the ground in the rest stance, m")
    base: v.Word | None = setting(
        None, "body that the limbs begin at, where the file's root is a foot; null: as in the file"
    )
    limbs: Limbs = Field(description="joints and feet")
    locked: Locked = setting(Locked(), "joints of the file that belong to no limb, held at a value")
    springs: Springs = setting(Springs(), "joints of limbs that nothing drives, each on a spring")


AnyRobot = Annotated[
    Annotated[v.Name, Tag("name")] | Annotated[RobotFile, Tag("file")],
    Discriminator(lambda value: "file" if isinstance(value, (Mapping, RobotFile)) else "name"),
]


class OwnObject(v.Section):
    """What a file of the user's defines, and the options that name it as FILE.py:NAME."""

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


class OwnValues(_ByName):
    """Values by the names that a contact, an actuator or a disturbance gives them."""

    __pydantic_extra__: dict[str, v.Values]


class OwnOptions(_ByName):
    """Fields of a contact, an actuator or a disturbance that are none of its values, by their names."""

    __pydantic_extra__: dict[str, v.Option]


class OwnComponent(OwnObject):
    """A contact, an actuator, a disturbance or a choice of footholds: a shipped one, by its name, or the user's."""

    values: OwnValues = setting(OwnValues(), "in place of its own, SI units")
    options: OwnOptions = setting(OwnOptions(), "in place of its own; a walk is compiled for them")


class Own(v.Section):
    """What walked, or judged the walks, beside what comes with the program."""

    law: OwnLaw | None = setting(None, "control law in place of the control section's")
    metrics: tuple[OwnObject, ...] = setting((), "metrics beside the shipped ones")
    objective: OwnObject | None = setting(None, "objective of a search from Python")
    method: OwnObject | None = setting(None, "method of a search whose settings say own")
    contact: OwnComponent | None = setting(None, "what holds feet, in place of the gripper of the contact section")
    drive: OwnComponent | None = setting(None, "what turns joints, in place of the servos of the hardware section")
    disturbances: tuple[OwnComponent, ...] = setting((), "what acts from outside, beside cargo and pushes")
    footholds: OwnComponent | None = setting(None, "what chooses footholds, in place of gait.footholds")

    @property
    def components(self) -> dict[str, OwnComponent]:
        """The components, as far as there are any, by their places: "disturbances.0"."""
        found = {"contact": self.contact, "drive": self.drive, "footholds": self.footholds}
        found |= {f"disturbances.{n}": each for n, each in enumerate(self.disturbances)}
        return {place: each for place, each in found.items() if each is not None}


class Scenario(v.Section):
    """One walk of one robot, fully specified. Immutable and hashable."""

    robot: AnyRobot = setting("hubrobo_v3_2", "name of the robot, or your own from a file")
    gravity: v.Gravity = setting((0.0, 0.0, -9.81), "gravity, world axes, m/s^2; a slope tilts it")
    duration: v.Positive = setting(8.0, "length of the walk, s; a whole number of time steps")
    time_step: v.Positive = setting(0.001, "time step of the simulation, s")
    gait: Gait = setting(Gait(), "how the limbs move")
    ground: Ground = setting(Ground(), "heights of the footholds")
    contact: Contact = setting(Contact(), "how the grippers hold the ground")
    control: Control = setting(Control(), "controller and gains")
    disturbance: Disturbance = setting(Disturbance(), "cargo and pushes")
    hardware: Hardware = setting(Hardware(), "sensors, rate, bus and servos; ideal ones by default")
    own: Own | None = setting(None, "law, metrics, contact and more of your own: files are run")

    @model_validator(mode="after")
    def _gains_of_registers(self) -> Scenario:
        servo = self.hardware.servo
        held, scale, stall_torque = servo.registers, servo.register_scale, servo.torque_limit
        if held is not None and scale is not None and stall_torque is not None:
            found = registers.gains_of(registers.Registers(held.p, held.i, held.d), scale, stall_torque)._asdict()
            self.__dict__["control"] = self.control.model_copy(update=found)  # frozen, but not read by anyone yet
        return self

    @model_validator(mode="after")
    def _whole_steps(self) -> Scenario:
        hardware, step = self.hardware, f"time steps of {self.time_step:g} s"
        spans = {"duration": self.duration, "gait.cycle": self.gait.cycle}
        for key, span in {**spans, "hardware.control_period": hardware.control_period}.items():
            steps, none = span / self.time_step, "" if key in spans else ", or 0"
            if steps > MAX_STEPS:
                raise failure(f"at most {MAX_STEPS} {step}", key=key, got=span)
            if (not none and round(steps) < 1) or not math.isclose(steps, round(steps), rel_tol=1e-9, abs_tol=1e-9):
                raise failure(f"a whole number of {step}{none}", key=key, got=span)
        if (rate := hardware.servo.rate) is not None:
            steps = 1 / (rate * self.time_step)
            if round(steps) < 1 or not math.isclose(steps, round(steps), rel_tol=1e-9):
                raise failure(f"a rate whose period is a whole number of {step}", key="hardware.servo.rate", got=rate)
        delays = {f"{key}.delay": getattr(hardware, key).delay for key in ("force_sensor", "base_estimate", "servo")}
        for key, delay in {"command_delay": hardware.command_delay, **delays}.items():
            if delay / self.time_step > MAX_DELAY:
                raise failure(f"at most {MAX_DELAY} {step}", key=f"hardware.{key}", got=delay)
        if int((1 - self.gait.duty) * self.gait.cycle / self.time_step + 1e-6) < 2:
            raise failure(f"a swing, (1 - duty) cycle, of two {step} or more", key="gait.duty", got=self.gait.duty)
        return self

    @model_validator(mode="after")
    def _limbs_are_the_robots_and_one_stands(self) -> Scenario:
        gait, limbs = self.gait, SHIPPED_LIMBS if isinstance(self.robot, str) else tuple(dict(self.robot.limbs.items()))
        known = f"the {NUMBERS[len(limbs)]} limbs {', '.join(limbs)}"
        swings = list(gait.lift_off) if gait.phases is not None else [limb for place in gait.places for limb in place]
        if sorted(swings) != sorted(limbs):
            if gait.phases is None:
                raise failure(f"{known}, each once, in any order", key="gait.sequence", got=gait.sequence)
            raise failure(f"a phase for each of {known}", key="gait.phases", got=gait.lift_off)
        by_limb = {
            "ground.footholds": self.ground.footholds,
            "hardware.force_sensor.dead": self.hardware.force_sensor.dead,
        }
        for key, values in by_limb.items():
            for name in dict(values.items()) if values is not None else ():
                if name not in limbs:
                    raise failure(f"one of the limbs {', '.join(limbs)}", key=f"{key}.{name}", got=name)
        # one limb stands at any time
        least, swing = 1 - 1 / len(gait.sequence), 1 - gait.duty
        if gait.phases is None and gait.duty < least - _ROUNDING:
            expected = f"a number from {least:g} to below 1, so that one swing ends as the next begins"
            raise failure(expected, key="gait.duty", got=gait.duty)
        for limb, phase in gait.lift_off.items() if gait.phases is not None else ():
            if phase + swing > 1 + _ROUNDING:
                expected = f"a swing that ends within the cycle, phase {gait.duty:g} or less"
                raise failure(expected, key=f"gait.phases.{limb}", got=phase)
            if all(other <= phase < other + swing - _ROUNDING for other in gait.lift_off.values()):
                raise failure("a limb on the ground at every moment", key=f"gait.phases.{limb}", got=phase)
        return self

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

    def to_yaml(self) -> str:
        """The resolved scenario as YAML; loading it gives an equal scenario."""
        data = {key: value for key, value in self.model_dump(mode="json").items() if key != "own" or value}
        return yaml.dump(data, Dumper=Dumper, sort_keys=False, default_flow_style=None, width=110)

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
            named |= {f"own.{place}": each for place, each in self.own.components.items()}
        keys = ("file", "mask")
        files = {f"{place}.{key}": getattr(section, key, None) for place, section in named.items() for key in keys}
        return self.with_overrides({key: change(key, file) for key, file in files.items() if file is not None})

    def relative_to(self, folder: str | os.PathLike[str]) -> Scenario:
        """A copy in which paths of files inside a folder are relative to it."""
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
        ConfigError: in one line, `source`, key, what was expected and what was got.
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
        for key, value in pairs(overrides, source):
            assign(data, key, value, source)
            if key in _OF_REGISTERS:  # what is set last holds
                assign(data, "hardware.servo.registers", None, source)
    except RecursionError:
        raise config_error(source, "", "overrides of a few levels", "endless nesting") from None
    return validated(Scenario, data, source)
