"""Recursive Newton-Euler: the forces that given accelerations need, one limb at a time.

It runs in the links' own frames, where inertias and the places of the next joints are constant, so that derivatives
stay short: those of the accelerations are made of them (`mjx_climb.dynamics.limb_engine`).

References:
    J. Y. S. Luh, M. W. Walker, R. P. C. Paul, On-Line Computational Scheme for Mechanical Manipulators, 1980.
    R. Featherstone, Rigid Body Dynamics Algorithms, 2008: section 5.3.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.numpy import cross

from mjx_climb.dynamics.kinematics import LinkPose, by_kind, link_poses
from mjx_climb.dynamics.spatial import AnyArray, quaternion_to_matrix, skew, symmetric
from mjx_climb.dynamics.state import Acceleration, Loads, State
from mjx_climb.robot.constants import Robot

_AXIS = np.array([0.0, 0.0, 1.0], np.float32)  # of a joint in its link's frame


class Limb(NamedTuple):
    """The bodies of a limb of N joints."""

    mass: AnyArray  # (N,) kg
    center: AnyArray  # (N, 3) m, link frame
    inertia: AnyArray  # (N, 3, 3) kg m^2 about the centre, link frame
    foot: AnyArray  # (3,) m, frame of the last link
    armature: AnyArray  # (N,) kg m^2; None: there is none


class JointMotion(NamedTuple):
    """How joints move, along their own axes and in the links' frames: zero where a joint is of the other kind."""

    spin: AnyArray  # (N, 3) rad/s
    spin_change: AnyArray  # (N, 3) rad/s^2
    slide: AnyArray  # (N, 3) m/s; None: no joint of the robot slides
    slide_change: AnyArray  # (N, 3) m/s^2


class BodyMotion(NamedTuple):
    """How a body moves, in its own axes."""

    velocity: Array  # (3,) rad/s, angular
    turning: Array  # (3,) rad/s^2, angular acceleration
    linear: Array  # (3,) m/s^2, acceleration of the frame's origin less gravity

    @property
    def tensor(self) -> Array:
        """What the acceleration of a point gains with its place, (3, 3) 1/s^2: `[turning] + [velocity]^2`."""
        outer = symmetric(jnp.outer(self.velocity, self.velocity))
        return skew(self.turning) + outer - jnp.trace(outer) * jnp.eye(3, dtype=outer.dtype)

    def at(self, point: Array) -> Array:
        """Return the acceleration less gravity (3,) of a point of the body."""
        return self.linear + self.tensor @ point


class Needed(NamedTuple):
    """Forces that a motion needs of a limb's joints, and of what the limb hangs on."""

    along: Array  # (N,) N, along the joints' axes
    about: Array  # (N,) N m, about them
    force: Array  # (3,) N, in the axes of what the limb hangs on
    moment: Array  # (3,) N m, about the origin of its frame


class Forces(NamedTuple):
    """Generalised forces of a robot, in the base's axes and about its centre of mass."""

    joint: Array  # (limb, joint) N m, N of sliding joints
    limb_force: Array  # (limb, 3) N, of the limbs on the base
    limb_moment: Array  # (limb, 3) N m
    force: Array  # (3,) N, on the base beside these
    moment: Array  # (3,) N m


def limbs_of(robot: Robot) -> Limb:
    """Return the bodies of all limbs, limb axis first."""
    return Limb(robot.link_mass, robot.link_center, robot.link_inertia, robot.foot_center, robot.armature)


def missing_forces(robot: Robot, state: State, acceleration: Acceleration, loads: Loads) -> Forces:
    """Return what acts less what the accelerations need: zero at those that obey the equations of motion."""
    to_base = quaternion_to_matrix(state.base_orientation).T
    base = BodyMotion(
        to_base @ state.base_angular_velocity,
        to_base @ acceleration.base_angular,
        to_base @ (acceleration.base_linear - loads.gravity),
    )
    poses = link_poses(robot, state.joint_angles)
    needed = jax.vmap(_newton_euler, in_axes=(0, 0, 0, None, 0))(
        limbs_of(robot), poses, _joint_motion(robot, state, acceleration), base, loads.foot_force @ to_base.T
    )
    slides = robot.sliding
    joint = loads.joint_torque - (needed.about if slides is None else jnp.where(slides, needed.along, needed.about))
    if robot.armature is not None:
        joint = joint - robot.armature * acceleration.joints
    mass, spin = robot.base_mass + loads.cargo_mass, robot.base_inertia @ base.velocity
    moment = robot.base_inertia @ base.turning + cross(base.velocity, spin)
    return Forces(
        joint=joint,
        limb_force=-needed.force,
        limb_moment=-needed.moment,
        force=to_base @ loads.base_wrench[:3] - mass * base.linear,
        moment=to_base @ loads.base_wrench[3:] - moment,
    )


def _joint_motion(robot: Robot, state: State, acceleration: Acceleration) -> JointMotion:
    parts = zip(by_kind(robot, state.joint_rates), by_kind(robot, acceleration.joints), strict=True)
    return JointMotion(*(None if part is None else part[..., None] * _AXIS for pair in parts for part in pair))


def _newton_euler(limb: Limb, pose: LinkPose, joints: JointMotion, base: BodyMotion, foot_force: Array) -> Needed:
    """Return the forces that one limb needs, for a base and a force on its foot (3,) N in the base's axes."""
    links = range(len(limb.mass))
    motion, loads = base, []
    for i in links:  # outward: how each link moves, and the force and moment that this needs
        turn = pose.rotation[i].T
        linear, velocity, turning = turn @ motion.at(pose.position[i]), turn @ motion.velocity, turn @ motion.turning
        if joints.slide is not None and joints.slide_change is not None:
            linear = linear + cross(2 * velocity, joints.slide[i]) + joints.slide_change[i]
        turning = turning + cross(velocity, joints.spin[i]) + joints.spin_change[i]
        motion = BodyMotion(velocity + joints.spin[i], turning, linear)
        foot_force = turn @ foot_force
        force = limb.mass[i] * motion.at(limb.center[i])
        spin = cross(motion.velocity, limb.inertia[i] @ motion.velocity)
        loads.append((force, limb.inertia[i] @ turning + spin + cross(limb.center[i], force)))

    force, moment, along, about = -foot_force, cross(foot_force, limb.foot), [], []
    for i in reversed(links):  # inward: the loads of all that is beyond a joint
        force, moment = force + loads[i][0], moment + loads[i][1]
        along.append(force[2])
        about.append(moment[2])
        force = pose.rotation[i] @ force
        moment = pose.rotation[i] @ moment + cross(pose.position[i], force)
    return Needed(jnp.stack(along[::-1]), jnp.stack(about[::-1]), force, moment)
