"""Recursive Newton-Euler: the forces that given accelerations need, one limb at a time.

It runs in the links' own frames, where inertias and the places of the next joints are constant, so that derivatives
stay short: those of the accelerations are made of them (`mjx_climb.physics.limb_engine`).

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

from mjx_climb.arrays import AnyArray
from mjx_climb.physics.kinematics import LinkPose, by_kind, link_poses
from mjx_climb.physics.spatial import quaternion_to_matrix, skew, symmetric
from mjx_climb.physics.state import Acceleration, Loads, State
from mjx_climb.robot.constants import Robot

_AXIS = np.array([0.0, 0.0, 1.0], np.float32)  # of a joint in its link's frame


class Limb(NamedTuple):
    """The bodies of a limb of N joints."""

    mass: AnyArray  # (N,) kg
    center: AnyArray  # (N, 3) m, link frame
    inertia: AnyArray  # (N, 3, 3) kg m^2 about the centre, link frame
    foot: AnyArray  # (3,) m, frame of the last link
    armature: AnyArray  # (N,) kg m^2; None: there is none


class BodyMotion(NamedTuple):
    """How a body moves, in its own axes."""

    velocity: Array  # (3,) rad/s, angular
    turning: Array  # (3,) rad/s^2, angular acceleration
    linear: Array  # (3,) m/s^2, acceleration of the frame's origin less gravity

    def at(self, point: Array) -> Array:
        """Return the acceleration less gravity (3,) of a point of the body: `linear + ([turning] + [velocity]^2) p`."""
        outer = symmetric(jnp.outer(self.velocity, self.velocity))
        return self.linear + (skew(self.turning) + outer - jnp.trace(outer) * jnp.eye(3, dtype=outer.dtype)) @ point


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
    """Return the residual of the equations of motion (paper Eq. 1) at given accelerations."""
    to_base = quaternion_to_matrix(state.base_orientation).T
    linear, angular = to_base @ (acceleration.base_linear - loads.gravity), to_base @ acceleration.base_angular
    base = BodyMotion(to_base @ state.base_angular_velocity, angular, linear)
    # along the joints' axes, zero where a joint is of the other kind; None: no joint of the robot slides
    by_joint = zip(by_kind(robot, state.joint_rates), by_kind(robot, acceleration.joints), strict=True)
    joints = [None if part is None else part[..., None] * _AXIS for pair in by_joint for part in pair]
    along, about, limb_force, limb_moment = jax.vmap(_newton_euler, in_axes=(0, 0, 0, None, 0))(
        limbs_of(robot), link_poses(robot, state.joint_angles), joints, base, loads.foot_force @ to_base.T
    )
    slides = robot.sliding
    joint = loads.joint_torque - (about if slides is None else jnp.where(slides, along, about))
    if robot.armature is not None:
        joint = joint - robot.armature * acceleration.joints
    spin = robot.base_inertia @ base.velocity
    return Forces(
        joint=joint,
        limb_force=-limb_force,
        limb_moment=-limb_moment,
        force=to_base @ loads.base_wrench[:3] - (robot.base_mass + loads.cargo_mass) * linear,
        moment=to_base @ loads.base_wrench[3:] - (robot.base_inertia @ angular + cross(base.velocity, spin)),
    )


def load_torque(robot: Robot, state: State, loads: Loads) -> Array:
    """Return the torque of loads, gravity and motion on the joints, (limb, joint) N m: `-c + J^T f`.

    It stands beside the servos' torques in `H qdd = tau - c + J^T f`, so without the inertia of base and links.
    """
    still = Acceleration(*map(jnp.zeros_like, (loads.gravity, loads.gravity, loads.joint_torque)))
    return missing_forces(robot, state, still, loads).joint


def _newton_euler(
    limb: Limb, pose: LinkPose, joints: list[AnyArray], base: BodyMotion, foot_force: Array
) -> tuple[Array, Array, Array, Array]:
    """Return the forces that one limb needs, for a base and a force on its foot (3,) N in the base's axes.

    They are those along and about the joints' axes, (N,) N and N m, and the force (3,) N and moment (3,) N m of the
    base on the limb. `joints` are spin, spin change, slide and slide change, (N, 3) each, in the links' frames.
    """
    spin, spin_change, slide, slide_change = joints
    links = range(len(limb.mass))
    motion, loads = base, []
    # outward: the motion of each link, and the force and moment that it needs (Featherstone, section 5.3)
    for i in links:
        turn = pose.rotation[i].T
        linear, velocity, turning = turn @ motion.at(pose.position[i]), turn @ motion.velocity, turn @ motion.turning
        if slide is not None:
            linear = linear + cross(2 * velocity, slide[i]) + slide_change[i]
        turning = turning + cross(velocity, spin[i]) + spin_change[i]
        motion = BodyMotion(velocity + spin[i], turning, linear)
        foot_force = turn @ foot_force
        force = limb.mass[i] * motion.at(limb.center[i])
        moment = limb.inertia[i] @ turning + cross(motion.velocity, limb.inertia[i] @ motion.velocity)
        loads.append((force, moment + cross(limb.center[i], force)))

    force, moment, along, about = -foot_force, cross(foot_force, limb.foot), [], []
    # inward: the loads of all that is beyond a joint
    for i in reversed(links):
        force, moment = force + loads[i][0], moment + loads[i][1]
        along.append(force[2])
        about.append(moment[2])
        force = pose.rotation[i] @ force
        moment = pose.rotation[i] @ moment + cross(pose.position[i], force)
    return jnp.stack(along[::-1]), jnp.stack(about[::-1]), force, moment
