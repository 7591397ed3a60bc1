"""The predicted log of a gripped robot, its base free: window after window, with exact derivatives.

Grips and servos damp the initial motion of a robot of shut grippers, so that no state is fitted: it stands under the
log's commands for a window's length before the log begins, and goes on from window to window. The places of its grips
are fitted.
"""

import dataclasses
from collections.abc import Collection, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from scipy.spatial.transform import Rotation

import mjx_climb as mc
from mjx_climb import execution
from mjx_climb.disturbances.disturbance import Disturbance
from mjx_climb.disturbances.on_base import Cargo, Push
from mjx_climb.hardware.servo import Servos
from mjx_climb.hardware.stages import hardware_of
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.parameter_types import Parameters
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.physics.state import State
from mjx_climb.robot.constants import Robot
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from tuning.identification.model import held_base as stands
from tuning.identification.model import held_feet as grips
from tuning.identification.model import predicted as model
from tuning.identification.model.force_sensors import logged_force
from tuning.identification.model.predicted import (
    LATENESS,
    LEAD,
    Fit,
    Given,
    Point,
    Structure,
    leaves_of,
    over_steps,
    stages_for,
    structure_of,
    with_nuisances,
)
from tuning.identification.model.variables import Place, Variable, applied
from tuning.identification.model.windows import KINDS, Windows, cut
from tuning.identification.readers.log import Log, Signal, joints_of

FORCE_DELAY, LATE_FORCE = "hardware.force_sensor.delay", "log.force.delay"
LATE = {  # kinds that are recorded late, by the keys of their delays
    **model.LATE,
    FORCE_DELAY: ("force",), LATE_FORCE: ("force",), "log.base.delay": KINDS[4:],
}  # fmt: skip
_GRIP = (0.0, 0.003, -0.1, 0.1)  # m, of a grip point from where the foot is seen


def cut_gripped(log: Log, robot: Robot, time_step: float, held_out: float) -> Windows:
    """Return the windows of a gripped robot's log.

    Raises:
        ConfigError: joints without commands, a gripper that opens, a push, or too short a log.
    """
    for name in log.signals:
        if name.endswith(".support") and not log.signals[name].value.all():
            opened = float(log.signals[name].time[np.argmin(log.signals[name].value)])
            raise ConfigError(log.source, "", "all grippers shut (a sway)", f"{name} 0 at {opened:.4g} s")
        if name.startswith(("base.force.", "base.moment.")) and log.signals[name].value.any():
            raise ConfigError(log.source, "", "no push on the base of a robot that is identified", name)
    if missing := [name for joint in joints_of(robot) if (name := f"{joint}.command") not in log.signals]:
        expected = "the commands of all joints of a gripped robot"
        raise ConfigError(log.source, "", expected, f"none of {missing[0]} (--base held: some limbs)")
    return cut(log, robot, time_step, held_out, KINDS)


def simulate(structure: Structure, point: Point, given: Given, parameters: Parameters) -> dict[str, Array]:
    """Return the predicted records at steps 0 to `steps`, and the leaves of the state at the last one."""
    dtype = point.x.dtype
    nominal = structure.robot
    parameters, robot = applied(structure.places, point.x, parameters, nominal)
    # states are of the base's nominal centre of mass, but in the simulation itself
    center = jnp.asarray(nominal.frame_position[0, 0] - robot.frame_position[0, 0], dtype)
    robot = execution.of_limbs(jax.tree.map(lambda value: jnp.asarray(value, dtype), robot))
    hardware = hardware_of(parameters, structure.stages, structure.time_step, robot)
    points, stood = given.common
    gripped = grips.gripped(robot, hardware, stood, points + _of_grips(structure.places, point.x, robot))
    first = _about(point.start, center)
    limbs = first.limbs._replace(state=execution.of_limbs(first.limbs.state))

    def advance(moving: grips.Moving, sent: stands.Sent) -> tuple[grips.Moving, grips.Recorded]:
        driven = stands.with_gains(stands.Stand(robot, hardware), sent).hardware
        after, seen = grips.advance(gripped._replace(hardware=driven), moving, sent.targets)
        # the rate as it stands, half a step before the angle: right where the target jumps too
        arm = -quaternion_to_matrix(seen.base_orientation) @ center
        return after, seen._replace(
            velocity=moving.limbs.state.joint_rates, base_position=seen.base_position + arm,
            base_linear_velocity=seen.base_linear_velocity + jnp.cross(seen.base_angular_velocity, arm),
            force=logged_force(structure.places, point.x, robot.limbs, seen.force),
        )  # fmt: skip

    last, seen = over_steps(advance, structure, point, given, first._replace(limbs=limbs))
    seen = {kind: value[:, None] if kind.startswith("base") else value for kind, value in seen.items()}
    return seen | leaves_of(_about(last, -center))


def _about(moving: grips.Moving, by: Array) -> grips.Moving:
    """Return a robot whose base's position and velocity are those of another point of it, `by` (3,) m off."""
    state = moving.limbs.state
    arm = quaternion_to_matrix(state.base_orientation) @ by
    velocity = state.base_linear_velocity + jnp.cross(state.base_angular_velocity, arm)
    state = dataclasses.replace(state, base_position=state.base_position + arm, base_linear_velocity=velocity)
    return moving._replace(limbs=moving.limbs._replace(state=state))


def _of_grips(places: Sequence[Place], x: Array, robot: Robot) -> Array:
    """Return how far grip points (limb, 3) m are from where the log has them."""
    own = {place.key: value for place, value in zip(places, x, strict=True)}
    zero = jnp.zeros_like(x[0])
    return jnp.stack([
        jnp.stack([own.get(f"log.{limb}.grip.{axis}", zero) for axis in "xyz"]) for limb in robot.limbs
    ])  # fmt: skip


@dataclasses.dataclass(frozen=True)
class GrippedModel(Fit):
    """The model of a gripped robot's log."""

    points: Float[np.ndarray, "limb 3"]  # m, where grips are seen
    stood: State  # at the beginning of the log
    first: Sequence[State]  # at the beginning of each stretch

    LEADS, LATE, SIMULATE = 0.5, LATE, staticmethod(simulate)

    @property
    def common(self) -> tuple[Any, State]:
        """Where grips are seen, and how the robot stood when it gripped."""
        return self.points, self.stood

    def begun(self, x: np.ndarray, start: np.ndarray, firsts: np.ndarray) -> tuple[Any, Any]:
        """The robot at rest on its grips, a window's length before each stretch."""
        robot = self.structure.robot
        with jax.enable_x64(True):
            hardware = hardware_of(self.parameters, self.structure.stages, self.structure.time_step, robot)
            each = [grips.begin(hardware, jax.tree.map(jnp.asarray, state)) for state in self.first]
            moving: grips.Moving = jax.tree.map(lambda *leaves: np.stack(leaves), *each)
        count = len(self.lanes)
        return moving, jax.tree.map(lambda value: np.zeros((len(value), count, *value.shape[1:])), moving)


def gripped_model(scenario: mc.Scenario, log: Log, windows: Windows, chosen: Sequence[Variable]) -> GrippedModel:
    """The model of a gripped robot's log, with the nuisances beside the chosen variables."""
    robot, own = load_robot(scenario.robot), own_parameters(scenario)
    every = gripped_with_nuisances(scenario, chosen, windows.kinds)
    every += [Variable(f"log.{limb}.grip.{a}", "m", 0.0, *_GRIP, beside=True) for limb in robot.limbs for a in "xyz"]
    stages = stages_for(scenario, chosen)._replace(
        force_delay=0, force_noise=False, force_resolution=False, force_dead=False, base_delay=0, base_noise=False
    )
    structure = structure_of(scenario, tuple(v.place for v in every), stages, windows)
    angles = windows.start[~windows.abuts, :, :, 0]
    position, orientation = _posed(log, robot, windows.begin[0])
    feet = position + limb_frames(robot, np.asarray(quaternion_to_matrix(orientation), float), angles[0]).foot
    # a foot hangs below its grip by its load
    weight = float(robot.total_mass) * np.asarray(own.gravity) / len(robot.limbs)
    states = [_state(*_registered(robot, each, feet), each) for each in angles]
    points = feet - weight / float(own.contact.springs().stiffness)
    return GrippedModel(windows, tuple(every), structure, own, points, states[0], states)


def check_parts(own: Parameters, *, held: bool) -> None:
    """Refuse parts that the model of a log does not have, its base held or free.

    Raises:
        ConfigError: a disturbance, since the log has the pushes; a drive that feels the load or whose
            memory is no real numbers, with the base held any but servos; a contact without springs.
    """
    for place, each in own.components.items():
        if isinstance(each, Disturbance) and not isinstance(each, Cargo | Push):
            raise ConfigError("", place, "none with a log", type(each).__name__)
    drive, name = own.drive, type(own.drive).__name__
    if not isinstance(drive, Servos):
        if held:
            raise ConfigError("", "hardware.servo", "servos with the base held", name)
        leaves = jax.tree.leaves(jax.eval_shape(drive.init, jnp.zeros((3, 3))))
        if drive.feels_load or not all(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves):
            expected = "expected a drive that remembers real numbers and asks for no load"
            raise ConfigError(f"hardware.servo: {expected} with a log, got {name}")
    if not held and own.contact.springs() is None:
        raise ConfigError("", "contact", "one with springs with a log", type(own.contact).__name__)


def gripped_with_nuisances(scenario: mc.Scenario, chosen: Sequence[Variable], kinds: Collection[str]) -> list[Variable]:
    """Variables, and beside them the nuisances of a gripped robot's log, but for the places of its grips."""
    found = [v for v in with_nuisances(scenario, chosen, kinds) if v.key != LEAD]
    if len(kinds) > 1:
        late = [LATE_FORCE] if "force" in kinds and FORCE_DELAY not in {v.key for v in chosen} else []
        late += ["log.base.delay"] if {*kinds} & set(KINDS[4:]) else []
        found += [Variable(key, "s", 0.0, *LATENESS, beside=True) for key in late]
    return found


def _posed(log: Log, robot: Robot, moment: float) -> tuple[np.ndarray, np.ndarray]:
    """Return position (3,) m and orientation (4,) of the base as logged, the rest stance's where they are not."""
    found = []
    for what, axes in (("position", "xyz"), ("orientation", "wxyz")):
        rest = np.asarray(getattr(robot, f"stance_{what}"), float)
        signals: list[Signal | None] = [log.signals.get(f"base.{what}.{axis}") for axis in axes]
        own = [r if s is None else np.interp(moment, s.time, s.value) for s, r in zip(signals, rest, strict=True)]
        found.append(np.array(own, float))
    position, orientation = found
    return position, orientation / np.linalg.norm(orientation)


def _registered(robot: Robot, angles: np.ndarray, feet: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return position and orientation of the base at which feet are nearest to where they grip, (limb, 3) m."""
    seen = np.asarray(limb_frames(robot, None, angles).foot)
    turn, _ = Rotation.align_vectors(feet - feet.mean(0), seen - seen.mean(0))
    return feet.mean(0) - turn.apply(seen.mean(0)), turn.as_quat(scalar_first=True)


def _state(*values: np.ndarray) -> State:
    still: Any = np.zeros(3)
    position, orientation, angles = values
    given: Any = (position, orientation, still, still, angles, np.zeros_like(angles))
    return State(*given)
