"""The nominal robot as it is excited: how it is driven, which limits it has, and how much of them a motion uses."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from scipy.spatial.transform import Rotation

import mjx_climb as mc
from mjx_climb.hardware.stages import Stages, hardware_of
from mjx_climb.parameter_types import Parameters
from mjx_climb.physics.inverse_kinematics import Chain, inverse_kinematics, limb_geometry, solve_to_convergence
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.physics.state import State
from mjx_climb.robot.constants import Robot
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from tuning.identification.model import commanded
from tuning.identification.model.commanded import Carried, Commands
from tuning.identification.model.foot_mass import with_foot_mass
from tuning.identification.model.force_sensors import logged_force
from tuning.identification.model.gripped import LATE_FORCE
from tuning.identification.model.held_base import Sent
from tuning.identification.model.held_dynamics import held_accelerations
from tuning.identification.model.predicted import CLOCK, LEAD
from tuning.identification.model.schedule import Schedule
from tuning.identification.model.variables import Place, Variable, applied
from tuning.identification.plan.motions import Axes
from tuning.identification.plan.settings import Excitation
from tuning.identification.readers.log import Signal

RATE, SPEED = 100.0, 5.0  # Hz, rad/s: where the config has no control period, no speed without load
SETTLING = 1.0  # s, in the first posture before the log begins
_SWAY = (0.03, 0.15)  # m, rad: from where a sway is scaled
_ROUNDING = 1e-6  # relative: what limbs that are alike differ by, and below which a joint holds no weight


class Segment(NamedTuple):
    """A stretch of a motion that is scaled as one."""

    name: str
    start: int  # commands
    stop: int
    kp: float  # N m/rad; 0: torque off
    moved: Float[np.ndarray, "time axis"]  # from the centre, joints or six axes of the base


@dataclasses.dataclass(frozen=True)
class Rig:
    """The nominal robot as it is driven."""

    own: mc.Scenario  # as it was given
    scenario: mc.Scenario  # as it is simulated
    asked: Excitation
    robot: Robot  # with the masses on its feet
    parameters: Parameters
    stages: Stages
    hold: int  # time steps between two commands
    chosen: tuple[Variable, ...]  # variables that the log is to tell
    beside: tuple[Variable, ...] = ()  # nuisances of `identify`

    @property
    def period(self) -> float:
        """Time between two commands, s."""
        return self.hold * self.scenario.time_step

    @property
    def lead(self) -> int:
        """Commands before the log begins."""
        return round(SETTLING / self.period)

    @property
    def torque_limit(self) -> np.ndarray:
        """Of each joint (limb, joint), N m; infinite: none."""
        limit = np.minimum(self._hardware.drive.torque_limit, self._hardware.drive.current_limit)
        return np.broadcast_to(np.asarray(limit), self.robot.joint_lower.shape)

    @functools.cached_property
    def _hardware(self) -> Parameters:
        """Parameters as the supply voltage and the robot's file leave them."""
        own = hardware_of(self.parameters, self.stages, self.scenario.time_step, self.robot).parameters
        found: Parameters = jax.tree.map(np.asarray, own)
        return found

    @property
    def speed_limit(self) -> float:
        """Of the joints, rad/s."""
        speed = float(np.min(self._hardware.drive.no_load_speed))
        return speed if np.isfinite(speed) else SPEED

    @property
    def places(self) -> list[Place]:
        """Keys and coordinates of all variables, `beside` behind `chosen`."""
        return [each.place for each in (*self.chosen, *self.beside)]

    def _own(self, point: Array, key: str) -> Any:
        """Return a coordinate of a point; 0 where it is not among the variables."""
        keys = [place.key for place in self.places]
        return point[keys.index(key)] if key in keys else 0.0

    def at(self, point: Array) -> tuple[Robot, Parameters]:
        """Return robot and parameters at a point (n,) of the variables' coordinates."""
        parameters, robot = applied(self.places, point, self.parameters, load_robot(self.scenario.robot))
        late = jnp.asarray(parameters.bus.command_delay) + self._own(point, CLOCK)
        return with_foot_mass(robot, self.asked.mass), parameters.replace({"hardware.command_delay": late})

    def carried(self, point: Array, commands: Commands) -> Carried:
        """Return the motion of the robot of a point."""
        lead = {"lead": self._own(point, LEAD)} if self.asked.base == "held" else {}
        return self.run()(*self.at(point), commands, **lead)

    def logged_force(self, point: Array, force: Array) -> Array:
        """Return the logged forces (time, limb, 3) N on the feet, late by the delay of a point."""
        _, parameters = self.at(point)
        late = parameters.force_sensor.delay - self.parameters.force_sensor.delay + self._own(point, LATE_FORCE)
        change = jnp.asarray(jnp.gradient(force, self.scenario.time_step, axis=0))
        return logged_force(
            self.places, point, self.robot.limbs, force - late * change + jnp.asarray(parameters.force_sensor.bias)
        )

    def run(self) -> commanded.Simulate:
        """Return the simulation of commands."""
        if self.asked.base == "free":
            return commanded.standing(self.scenario, self.stages)
        return commanded.held(self.stages, self.scenario.time_step)

    def axes(self) -> Axes:
        """Return how far, fast and steeply the axes of a motion may go before anything is simulated."""
        share, robot = self.asked.margin, self.robot
        if self.asked.base == "free":
            room = np.repeat(_SWAY, 3)
            return Axes(room, share * self.speed_limit * room, np.full(6, np.inf))
        room = share * np.minimum(robot.joint_upper - robot.stance_joints, robot.stance_joints - robot.joint_lower)
        if robot.driven is not None:
            room = np.where(robot.driven, room, 0.0)
        inertia, holding = self.at_rest()
        left = share * self.torque_limit - np.abs(holding)
        if (left <= 0).any():
            limb, joint = np.argwhere(left <= 0)[0]
            name = f"torque of {robot.limbs[limb]}.{robot.joint_names[joint]}"
            expected = f"a rest stance that takes less than a share of {share:g} of the limit"
            got = f"{abs(holding[limb, joint]):.3g} of {self.torque_limit[limb, joint]:.3g} N m"
            raise ConfigError("excite", name, expected, got)
        return Axes(room.ravel(), np.full(room.size, share * self.speed_limit), (left / inertia).ravel())

    def at_rest(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the inertia that each joint moves, kg m^2, and the torque that holds it at rest, N m."""
        robot, shape = self.robot, self.robot.stance_joints.shape
        own = float(self.parameters.drive.armature) + (0.0 if robot.armature is None else np.asarray(robot.armature))
        robot = dataclasses.replace(robot, armature=np.broadcast_to(own, shape))
        still, angles = jnp.zeros(3), jnp.asarray(robot.stance_joints, float)
        state = State(still, jnp.asarray(robot.stance_orientation, float), still, still, angles, jnp.zeros(shape))
        each = [np.zeros(shape), *(np.broadcast_to(row, shape) for row in np.eye(shape[1]))]
        accelerations, gravity = jax.jit(held_accelerations), jnp.asarray(self.parameters.gravity, float)
        free, *driven = (np.asarray(accelerations(robot, state, torque, gravity)) for torque in each)
        inertia = np.linalg.inv(np.stack(driven, axis=2) - free[..., None])
        return np.diagonal(inertia, axis1=1, axis2=2), -np.matvec(inertia, free)

    def falling(self) -> np.ndarray:
        """Return which way each joint (limb, joint) falls with its torque off, -1 or 1; 0 where it bears no weight."""
        holding = self.at_rest()[1]
        return -np.sign(np.where(np.abs(holding) > _ROUNDING * np.abs(holding).max(), holding, 0.0))

    def targets(self, moved: np.ndarray) -> np.ndarray:
        """Return the joint targets (time, limb, joint) rad of a motion, unreachable ones as NaN."""
        robot = self.robot
        if self.asked.base == "held":
            return np.asarray(robot.stance_joints + moved.reshape(len(moved), *robot.joint_lower.shape))
        geometry = limb_geometry(robot, self.parameters.contact.transmits_moments)
        start = np.asarray(quaternion_to_matrix(jnp.asarray(robot.stance_orientation)))
        feet = limb_frames(robot, None, np.asarray(robot.stance_joints)).foot
        turned = Rotation.from_rotvec(moved[:, 3:]).as_matrix()  # along the stance's own axes
        seen = (feet - (moved[:, :3] @ start)[:, None]) @ turned
        if isinstance(geometry, Chain):
            angles, missed = solve_to_convergence(
                geometry, seen, np.broadcast_to(robot.stance_joints, (*seen.shape[:2], robot.joints))
            )
            return np.where((missed < 1e-4)[..., None], angles, np.nan)
        found = inverse_kinematics(geometry, seen)
        return np.asarray(np.where(found.reachable[..., None], found.joint_angles, np.nan))

    def commands(self, targets: np.ndarray, segments: Sequence[Segment]) -> Commands:
        """Return the commands at each time step, the lead before the log included."""
        kp = np.ones(len(targets))
        for segment in segments:
            kp[segment.start : segment.stop] = segment.kp / float(self.parameters.joint_loop.kp)
        sent, kp = (np.repeat(np.concatenate([np.repeat(v[:1], self.lead, 0), v]), self.hold, 0) for v in (targets, kp))
        delay, step = float(self.parameters.bus.command_delay), self.scenario.time_step
        delays = np.full(len(sent), delay)
        if self.asked.base == "free":
            return Commands(Sent(sent), Sent(np.zeros_like(sent)), delays)
        if self.stages.linear:  # the line reaches a target at the end of its period
            before, into = np.concatenate([sent[: self.hold], sent[: -self.hold]]), np.arange(len(sent)) % self.hold
            sent = before + (sent - before) * ((into + 1) / self.hold)[:, None, None]
        time = np.arange(len(sent)) * step
        schedule = Schedule(time, kp, np.where(kp > 0, 1.0, 0.0))
        each = [schedule.targets(Signal(time, own), time - delay, step) for own in sent.reshape(len(sent), -1).T]
        late = zip(zip(*each, strict=True), schedule.at(time - delay, step), strict=True)
        reached, rates = (Sent(np.stack(own, 1).reshape(sent.shape), **gains) for own, gains in late)
        return Commands(reached, rates, delays)

    def used(self, targets: np.ndarray, carried: Carried) -> tuple[float, str]:
        """Return the largest share of a limit that a stretch uses, and which, in words."""
        robot, rates = self.robot, np.asarray(carried.rates)
        if not (np.isfinite(targets).all() and all(np.isfinite(value).all() for value in carried)):
            return np.inf, "reach"
        middle = np.asarray(robot.stance_joints)
        shares = {"speed": np.abs(rates) / self.speed_limit}
        for angles in (targets, np.asarray(carried.angles)):
            way = np.where(angles > middle, robot.joint_upper - middle, middle - robot.joint_lower)
            share = np.abs(angles - middle) / way
            shares["joint limit"] = np.maximum(shares.get("joint limit", 0.0), share.max(0)[None])
        torque, no_load = np.asarray(carried.torque), self._hardware.drive.no_load_speed
        line = np.clip(1 - np.sign(torque) * rates / no_load, 0.02, 1.0)  # share that the motor has left at its speed
        shares["torque"] = np.abs(torque) / (self.torque_limit * line)
        found = {}
        for name, share in shares.items():
            _, limb, joint = np.unravel_index(_first_of_largest(share), share.shape)
            found[f"{name} of {robot.limbs[limb]}.{robot.joint_names[joint]}"] = float(share.max())
        if self.asked.base == "free":
            found |= self._pull(np.asarray(carried.force))
        else:
            found |= self._clear(np.asarray(carried.angles))
        name = max(found, key=found.__getitem__)
        return found[name], name

    def _pull(self, force: np.ndarray) -> dict[str, float]:
        pulled = np.where(force[..., 2] < 0, np.linalg.norm(force, axis=-1), 0.0)
        limb = _first_of_largest(pulled.max(0))
        return {f"pull of {self.robot.limbs[limb]}": float(pulled.max() / self.parameters.contact.holding_limit)}

    def _clear(self, angles: np.ndarray) -> dict[str, float]:
        """Return how far a foot is from where it stands, of half the way to the next foot: so feet never meet."""
        rest = limb_frames(self.robot, None, np.asarray(self.robot.stance_joints)).foot
        between = np.linalg.norm(rest[:, None] - rest, axis=-1) + np.diag(np.full(len(rest), np.inf))
        feet = limb_frames(self.robot, None, np.asarray(angles)[:: self.hold]).foot
        share = np.linalg.norm(feet - rest, axis=-1) / (between.min(1) / 2)
        limb = _first_of_largest(share.max(0))
        return {f"reach of {self.robot.limbs[limb]}": float(share.max())}


def _first_of_largest(values: np.ndarray) -> int:
    """Return the place of the largest value, among those equal to rounding of the first: limbs that are alike tie."""
    return int(np.argmax(values >= values.max() * (1 - _ROUNDING)))
