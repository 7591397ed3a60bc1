"""The points that limbs reach: by inverse kinematics, or by ClimbLab's table of reach by height.

ClimbLab turns one pitch joint of a limb at a time, the other at an end of its range, and notes the foot every half
degree: four arcs. From the lowest row on, the arcs with the femur low or the tibia raised are the farthest reach by
height, the others the nearest. The row nearest in height counts. Here rows are computed where they are looked up, so
that a walk reads no table.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.arrays import AnyArray
from mjx_climb.physics.inverse_kinematics import Chain, JointSolution, LimbGeometry, inverse_kinematics
from mjx_climb.robot.constants import Robot

_SPARE = 0.05  # of the length of a limb, which is never stretched farther
_ROUNDS = 4  # of inverse kinematics without a closed form, from the rest stance
_ROW = np.radians(0.5)  # from row to row of the table


def posture(geometry: LimbGeometry | Chain, target: AnyArray) -> JointSolution:
    """Return the joint angles with feet at points (limb, 3) m of the base's axes, from the rest stance."""
    solution = inverse_kinematics(geometry, target)
    if isinstance(geometry, Chain):
        for _ in range(_ROUNDS - 1):
            solution = inverse_kinematics(geometry, target, solution.joint_angles)
    return solution


def within_reach(robot: Robot, geometry: LimbGeometry | Chain, target: AnyArray) -> AnyArray:
    """Return whether limbs reach points (limb, 3) m of the base's axes within their joints' limits, (limb,) bool.

    They must reach a little farther from their first joints: a limb that is stretched straight cannot give way, and
    its joint gains are stiffer at the foot than a time step allows.
    """
    solution = posture(geometry, target + _SPARE * (target - robot.frame_position[:, 0]))
    angles = solution.joint_angles
    return solution.reachable & ((angles >= robot.joint_lower) & (angles <= robot.joint_upper)).all(-1)


class Arcs(NamedTuple):
    """Rows of the table on arcs of circles in the limbs' planes, several arcs a limb (limb, arc)."""

    out: AnyArray  # m, centre, outward from the first joint's axis
    up: AnyArray  # m, along it
    radius: AnyArray  # m
    begin: AnyArray  # rad, elevation of the first row, seen from the centre
    row: AnyArray  # rad, from row to row, of either sign
    last: AnyArray  # number of the last row


class HeightTable(NamedTuple):
    """The reach of limbs by height."""

    hip_position: AnyArray  # (limb, 3) m, base axes
    hip_rotation: AnyArray  # (limb, 3, 3), base axes: x outward, z along the first joint's axis
    lower: AnyArray  # (limb,) rad, of the first joint
    upper: AnyArray  # (limb,) rad
    near: Arcs
    far: Arcs


def height_table(robot: Robot, geometry: LimbGeometry | Chain) -> HeightTable:
    """Return the table of a robot whose limbs have a yaw joint and two parallel pitch joints, in NumPy.

    Raises:
        TypeError: other limbs.
    """
    if isinstance(geometry, Chain):
        raise TypeError("expected limbs of a yaw joint and two parallel pitch joints, got others")
    near, far = [], []
    for limb in range(len(robot.limbs)):
        own = LimbGeometry(*(value[limb] for value in geometry))
        nearest, farthest = _arcs(own, robot.joint_lower[limb], robot.joint_upper[limb])
        near.append(nearest)
        far.append(farthest)
    lower, upper = robot.joint_lower[:, 0], robot.joint_upper[:, 0]
    return HeightTable(geometry.hip_position, geometry.hip_rotation, lower, upper, _stacked(near), _stacked(far))


def _arcs(limb: LimbGeometry, lower: np.ndarray, upper: np.ndarray) -> tuple[list[Arcs], list[Arcs]]:
    """Return the arcs of one limb that are nearest and those that are farthest, each of scalars."""
    bend = limb.tibia_angle - limb.femur_angle

    def links(femur: float, tibia: float) -> tuple[np.ndarray, np.ndarray]:
        one = limb.femur_angle + limb.femur_sign * femur
        other = one + bend + limb.tibia_sign * tibia
        return limb.femur_length * _along(one), limb.tibia_length * _along(other)

    def arc(femur: float, tibia: float, joint: int) -> Arcs:
        """The arc on which one joint turns over its range, 1: the femur's, 2: the tibia's."""
        first, second = links(femur, tibia)
        centre, arm = np.array([limb.femur_out, limb.femur_up]), first + second
        if joint == 2:
            centre, arm = centre + first, second
        sign = (limb.femur_sign, limb.tibia_sign)[joint - 1]
        last = np.floor((upper[joint] - lower[joint]) / _ROW + 1e-6)
        return Arcs(centre[0], centre[1], np.hypot(*arm), np.arctan2(arm[1], arm[0]), sign * _ROW, last)

    outer = [arc(lower[1], lower[2], 2), arc(lower[1], upper[2], 1)]
    inner = [arc(lower[1], lower[2], 1), arc(upper[1], lower[2], 2)]
    heights = [each.up + each.radius * np.sin(each.begin + each.row * np.arange(each.last + 1)) for each in outer]
    lowest, between = int(np.argmin(np.concatenate(heights))), len(heights[0])
    if lowest < between:
        return [_part(outer[0], 0, lowest), *inner], [_part(outer[0], lowest, between - 1), outer[1]]
    cut = lowest - between
    return [outer[0], _part(outer[1], 0, cut), *inner], [_part(outer[1], cut, outer[1].last)]


def _along(elevation: AnyArray) -> np.ndarray:
    return np.array([np.cos(elevation), np.sin(elevation)])


def _part(arc: Arcs, first: float, last: float) -> Arcs:
    return arc._replace(begin=arc.begin + first * arc.row, last=last - first)


def _stacked(limbs: list[list[Arcs]]) -> Arcs:
    """Return arcs with axes (limb, arc); a limb of fewer has its last one twice."""
    most = max(map(len, limbs))
    whole = [[*arcs, *[arcs[-1]] * (most - len(arcs))] for arcs in limbs]
    return Arcs(*(np.array([[arc[n] for arc in arcs] for arcs in whole]) for n in range(len(Arcs._fields))))


def outward(arcs: Arcs, height: Array) -> Array:
    """Return how far out the row is that is nearest to heights (limb,) m over the first joints, (limb,) m."""
    arc, over = Arcs(*(value[..., None] for value in arcs)), height[:, None, None]
    # the two places of the whole circle at this height, or its top or its bottom
    rising = jnp.arcsin(jnp.clip((over - arc.up) / arc.radius, -1.0, 1.0))
    turned = jnp.sign(arc.row) * (jnp.concatenate([rising, jnp.pi - rising], axis=2) - arc.begin)
    before = jnp.floor((turned - 2 * jnp.pi * jnp.floor(turned / (2 * jnp.pi))) / jnp.abs(arc.row))
    row = jnp.clip(jnp.concatenate([before, before + 1, 0 * rising], axis=2), 0.0, arc.last)
    angle = arc.begin + row * arc.row
    miss = jnp.abs(arc.up + arc.radius * jnp.sin(angle) - over)
    nearest = miss <= miss.min((1, 2), keepdims=True)
    return jnp.where(nearest, arc.out + arc.radius * jnp.cos(angle), -jnp.inf).max((1, 2))


def ranges(table: HeightTable, target: Array) -> tuple[Array, Array]:
    """Return how near and how far limbs reach at the heights of points (limb, 3) m of the base's axes, (limb,) m."""
    height = ((target - table.hip_position) * table.hip_rotation[:, :, 2]).sum(1)
    return outward(table.near, height), outward(table.far, height)


def within_ranges(table: HeightTable, limits: tuple[Array, Array], target: Array) -> Array:
    """Return whether points (limb, 3) m of the base's axes lie between limits of `ranges` and within the first joint's.

    The answer is (limb,) bool.
    """
    out, aside = (((target - table.hip_position) * table.hip_rotation[:, :, axis]).sum(1) for axis in (0, 1))
    away, turned = jnp.sqrt(out * out + aside * aside), jnp.arctan2(aside, out)
    near, far = limits
    return jnp.asarray((away > near) & (away < far) & (turned > table.lower) & (turned < table.upper))
