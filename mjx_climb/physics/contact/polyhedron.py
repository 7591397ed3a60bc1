"""Grips whose holding limit is a polyhedron of forces: magnets, microspines, suction with friction.

A grip has axes of its own: z along the ground's normal, x in the ground from the base to the foot, when the gripper
shut. It holds forces f of the ground on the foot, in these axes, with `A f <= b`: a pull has f_z < 0.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.component import parameter
from mjx_climb.physics.contact.contact import Grip, along_normal
from mjx_climb.physics.contact.gripper import GripperMemory, SpringGrip
from mjx_climb.physics.kinematics import Feet, Surface, Turning
from mjx_climb.physics.spatial import norm
from mjx_climb.value_field import FINITE, UNLIMITED

_TINY = 1e-9  # m, of a foot below the base, which has no direction outwards


class PolyhedralMemory(NamedTuple):
    """Memory of polyhedral grips beside that of grippers."""

    gripper: GripperMemory
    outward: Array  # (limb, 3) 1, direction in the ground from the base to the foot, when the gripper shut


class PolyhedralGripper(SpringGrip):
    """Grippers that hold the forces of a polyhedron."""

    KIND = "polyhedron"

    normals: Array = parameter(
        "1", shape=(None, 3), bounds=FINITE, default=np.array([[0.0, 0.0, -1.0]]), long_name="rows of A"
    )
    limits: Array = parameter("N", shape=(None,), bounds=UNLIMITED, default=np.array([15.0]), long_name="b")
    only_pulled: bool = False  # a pushed foot holds at any force, as in ClimbLab's rule

    def init(self, grip_point: Array, rotation: Array) -> PolyhedralMemory:
        """The memory of grippers that are shut around their middle and rest."""
        lever = grip_point - grip_point.mean(0)
        return PolyhedralMemory(super().init(grip_point, rotation), _outward(lever, None))

    def step(
        self, memory: PolyhedralMemory, feet: Feet, turning: Turning | None, closed: Array, ground: Array
    ) -> tuple[PolyhedralMemory, Grip]:
        """The memory after a step, and the contacts in it."""
        before, surface = memory.gripper, feet.surface
        after, grip = super().step(before, feet, turning, closed, ground)
        shuts = (grip.contact & ~before.touching)[:, None]
        outward = jnp.where(shuts, _outward(feet.lever, surface), memory.outward)
        used = self.utilization(in_grip(grip.foot_force, outward, surface))
        if self.only_pulled:
            used = jnp.where(along_normal(grip.foot_force, feet) < 0, used, 0.0)
        return self.used(PolyhedralMemory(after, outward), grip, used)

    def tear_off(self, memory: PolyhedralMemory, grip: Grip, torn: Array) -> tuple[PolyhedralMemory, Grip]:
        """Memory and contacts with some grips torn off in this step."""
        gripper, grip = super().tear_off(memory.gripper, grip, torn)
        return memory._replace(gripper=gripper), grip

    def utilization(self, force: Array) -> Array:
        """The largest share of a limit that forces (..., 3) N in a grip's axes use up, (...,) 1; above 1 none holds."""
        return jnp.max((force @ self.normals.T) / self.limits, axis=-1)

    def holding_force(self) -> Array:
        """The largest pull along the normal alone that a grip holds, () N; 0 where any is held."""
        most = jnp.min(
            jnp.where(self.normals[:, 2] < 0, self.limits / jnp.maximum(-self.normals[:, 2], _TINY), jnp.inf)
        )
        return jnp.where(jnp.isfinite(most), most, 0.0)


def in_grip(force: Array, outward: Array, surface: Surface | None = None) -> Array:
    """Forces (limb, 3) N of world axes in the axes of grips with directions outwards (limb, 3) in a surface."""
    if surface is not None:
        axes = outward, jnp.cross(surface.normal, outward), surface.normal
        return jnp.stack([(force * axis).sum(1) for axis in axes], axis=1)
    x, y, z = force[:, 0], force[:, 1], force[:, 2]
    along, across = outward[:, 0], outward[:, 1]
    return jnp.stack([x * along + y * across, y * along - x * across, z], axis=1)


def _outward(lever: Array, surface: Surface | None) -> Array:
    """Directions (limb, 3) in a surface of levers (limb, 3) m, along x, or y, where there is none."""
    if surface is None:
        along = jnp.concatenate([lever[:, :2], jnp.zeros_like(lever[:, 2:])], axis=1)
        other = jnp.array([1.0, 0.0, 0.0], lever.dtype)
    else:
        normal = surface.normal
        along = lever - (lever * normal).sum(1)[:, None] * normal
        steep = jnp.abs(normal[:, :1]) > 0.9
        aside = jnp.where(steep, jnp.array([0.0, 1.0, 0.0], lever.dtype), jnp.array([1.0, 0.0, 0.0], lever.dtype))
        other = aside - (aside * normal).sum(1)[:, None] * normal
        other = other / norm(other)[:, None]
    length = jnp.sqrt(jnp.maximum((along * along).sum(1), _TINY**2))[:, None]
    return jnp.where(length > _TINY, along / length, other)


def magnet(pull: float, friction: float, sides: int = 8) -> dict[str, np.ndarray]:
    """Normals and limits of a magnet: shear up to `friction` times the force on the ground, `pull` N at rest."""
    angles = 2 * np.pi * np.arange(sides) / sides
    # an inscribed pyramid: never a force that the cone does not hold
    level = np.column_stack([np.cos(angles), np.sin(angles)]) / np.cos(np.pi / sides)
    shear = np.column_stack([level, np.full(sides, -friction)])
    return {"normals": np.vstack([shear, [0.0, 0.0, -1.0]]), "limits": np.append(np.full(sides, friction * pull), pull)}


def microspines(
    pull_per_shear: float, largest_shear: float, friction: float = 0.5, unloaded: float = 0.5
) -> dict[str, np.ndarray]:
    """Normals and limits of microspines: a pull needs a foot that drags the ground towards the base.

    Arguments:
        pull_per_shear: N of pull for each N of shear towards the base; 1 is 45 degrees.
        largest_shear: N, at which spines or rock break.
        friction: of spines that are pushed against the ground and dragged outwards.
        unloaded: N, of pull or outward shear that spines hold without being loaded.
    """
    # the ground pulls a foot outwards, f_x > 0, that drags it towards the base
    rows = [
        ([-pull_per_shear, 0.0, -1.0], unloaded),
        ([-1.0, 0.0, -friction], unloaded),
        ([1.0, 0.0, 0.0], largest_shear),
        ([0.0, 1.0, 0.0], largest_shear),
        ([0.0, -1.0, 0.0], largest_shear),
    ]
    return {"normals": np.array([row for row, _ in rows]), "limits": np.array([limit for _, limit in rows])}


def scalar(limit: float, rings: int = 12, sides: int = 24) -> dict[str, np.ndarray]:
    """Normals and limits of forces up to `limit` N in any direction with a pull, for `only_pulled` grips."""
    up, around = np.meshgrid(np.linspace(0, np.pi / 2, rings), 2 * np.pi * np.arange(sides) / sides, indexing="ij")
    normals = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), -np.sin(up)], axis=-1).reshape(-1, 3)
    return {"normals": normals, "limits": np.full(len(normals), limit)}
