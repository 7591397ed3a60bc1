"""The constants of a robot that the equations need, read off its MuJoCo model."""

import dataclasses
import functools
import hashlib
from typing import ClassVar

import jax
import numpy as np
from jaxtyping import Float

from mjx_climb.mujoco_import import mujoco

PASSIVE = 1  # group of the joints that nothing drives, in the models simulated here
FILLING = 2  # group of the joints that only fill up a limb of fewer joints than others


class RobotError(ValueError):
    """A model that mjx_climb cannot use: the message names the model and the expected."""


_DRIVES = {"armature": "dof_armature", "damping": "dof_damping", "friction": "dof_frictionloss"}  # by MuJoCo's names
_STATIC = {"static": True}  # to JAX


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Robot:
    """A base with limbs of as many joints each, revolute or prismatic: masses, frames and limits.

    Every link has a frame at its joint whose z axis is the joint's axis; with the joint at zero, `frame_rotation` and
    `frame_position` place it in its parent's frame. The base frame sits at the base's centre of mass. Axes: limb, joint
    (from the base outwards), components. SI units; a prismatic joint's values are in m where a revolute one's are
    in rad. Robots are equal where constants and model are, wherever their files lie.
    """

    # whose first axis runs over the limbs
    OF_LIMBS: ClassVar[tuple[str, ...]] = (
        "link_mass", "link_center", "link_inertia", "frame_position", "frame_rotation", "foot_center", "joint_lower",
        "joint_upper", "stance_joints", "armature", "damping", "friction", "spring", "spring_rest", "torque_limit",
    )  # fmt: skip

    name: str = dataclasses.field(metadata=_STATIC)
    limbs: tuple[str, ...] = dataclasses.field(metadata=_STATIC)
    model: mujoco.MjModel = dataclasses.field(metadata=_STATIC)  # the source of the constants
    base_mass: Float[np.ndarray, ""]  # kg
    base_inertia: Float[np.ndarray, "3 3"]  # kg m^2, base frame
    link_mass: Float[np.ndarray, "limb joint"]  # kg
    link_center: Float[np.ndarray, "limb joint 3"]  # m, link frame
    link_inertia: Float[np.ndarray, "limb joint 3 3"]  # kg m^2 about the link's centre of mass, link frame
    frame_position: Float[np.ndarray, "limb joint 3"]  # m, parent frame
    frame_rotation: Float[np.ndarray, "limb joint 3 3"]
    foot_center: Float[np.ndarray, "limb 3"]  # m, frame of the last link
    joint_lower: Float[np.ndarray, "limb joint"]  # rad
    joint_upper: Float[np.ndarray, "limb joint"]  # rad
    stance_position: Float[np.ndarray, "3"]  # m, world
    stance_orientation: Float[np.ndarray, "4"]  # wxyz
    stance_joints: Float[np.ndarray, "limb joint"]  # rad
    # as the file says, None where it says nothing
    armature: Float[np.ndarray, "limb joint"] | None = None  # kg m^2, of the drives, seen at the joints
    damping: Float[np.ndarray, "limb joint"] | None = None  # N m s/rad
    friction: Float[np.ndarray, "limb joint"] | None = None  # N m, dry
    spring: Float[np.ndarray, "limb joint"] | None = None  # N m/rad
    spring_rest: Float[np.ndarray, "limb joint"] | None = None  # rad, where the springs are slack
    torque_limit: Float[np.ndarray, "limb joint"] | None = None  # N m, of the drives; infinite: none
    # by limb and joint; (): of none
    slides: tuple[tuple[bool, ...], ...] = dataclasses.field(default=(), metadata=_STATIC)  # it is prismatic
    passive: tuple[tuple[bool, ...], ...] = dataclasses.field(default=(), metadata=_STATIC)  # nothing drives it
    joint_names: tuple[str, ...] = dataclasses.field(default=(), metadata=_STATIC)  # of a limb, from the base outwards
    # limbs in the order of the robot's file, with the names that their joints have there
    joints_in_file: tuple[tuple[str, tuple[str, ...]], ...] = dataclasses.field(default=(), metadata=_STATIC)

    @functools.cached_property
    def digest(self) -> str:
        """Digest of the constants and of the compiled model."""
        model = np.empty(mujoco.mj_sizeModel(self.model), np.uint8)
        mujoco.mj_saveModel(self.model, None, model)
        own = (getattr(self, field.name) for field in dataclasses.fields(self) if field.name != "model")
        parts = [value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode() for value in own]
        return hashlib.sha256(b"\0".join([*parts, model.tobytes()])).hexdigest()

    def __getstate__(self) -> dict[str, object]:
        # without the digest, which only some have computed yet
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Robot) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    @property
    def joints(self) -> int:
        """Number of joints of each limb."""
        return int(self.frame_position.shape[1])

    @property
    def sliding(self) -> np.ndarray | None:
        """Which joints are prismatic, (limb, joint) bool; None where none is."""
        return np.array(self.slides) if self.slides else None

    @property
    def driven(self) -> np.ndarray | None:
        """Which joints are driven, (limb, joint) bool; None where all are."""
        return ~np.array(self.passive) if self.passive else None

    def places_in_file(self) -> dict[str, tuple[int, int]]:
        """Return limb and joint by the names in the robot's file, in its order; of none that only fill up a limb."""
        return {
            name: (self.limbs.index(limb), joint) for limb, own in self.joints_in_file for joint, name in enumerate(own)
        }

    @property
    def total_mass(self) -> Float[np.ndarray, ""]:
        """Mass of base and links, kg."""
        mass: np.ndarray = self.base_mass + self.link_mass.sum()
        return mass


def frame_along(axis: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return a rotation matrix with z along the unit vector `axis`, and x as near to a direction as that allows."""
    x = x - axis * (axis @ x)
    # along the axis there is no such direction: the coordinate axis that is squarest to it takes its place
    if np.linalg.norm(x) < 1e-6:
        x = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def _flags(mask: np.ndarray) -> tuple[tuple[bool, ...], ...]:
    """Return a mask (limb, joint) as tuples, empty where it is false throughout."""
    return tuple(map(tuple, mask.tolist())) if mask.any() else ()


def robot_from_model(model: mujoco.MjModel, name: str, stance: np.ndarray | None = None) -> Robot:
    """Return the constants of a MuJoCo model: see `load_robot`.

    `stance` (nq,) is the rest stance; None: the model's first keyframe.
    """
    limbs, links = model.nsite, model.nbody - 2
    centred = links > 0 and np.abs(model.body_ipos[1]).max() < 1e-12
    if not (centred and model.nq == 7 + links and limbs and links % limbs == 0 and (stance is not None or model.nkey)):
        raise RobotError(
            f"{name}: expected a floating base with its frame at its centre of mass, limbs of as many links each, one "
            "hinge or slide a link, a foot site at the end of each limb, and a keyframe with the rest stance"
        )
    bodies, joints = (np.arange(n, n + links).reshape(limbs, -1) for n in (2, 1))  # (limb, joint), as all that follows
    stance = np.array(model.key_qpos[0] if stance is None else stance)
    limited, dofs, places = model.jnt_limited[joints] != 0, model.jnt_dofadr[joints], model.jnt_qposadr[joints]
    drives = {key: getattr(model, field)[dofs] for key, field in _DRIVES.items()}
    spring, limit = model.jnt_stiffness[joints], model.jnt_actfrcrange[joints, 1]
    limit = np.where(model.jnt_actfrclimited[joints] != 0, limit, np.inf)
    limb_names = tuple(model.body(body).name.rsplit("_", 1)[0] for body in bodies[:, 0])
    in_file = (tuple(model.joint(joint).name for joint in chain) for chain in joints)
    return Robot(
        name=name,
        limbs=limb_names,
        model=model,
        base_mass=np.array(model.body_mass[1]),
        link_mass=model.body_mass[bodies],
        **_frames(model, bodies),
        joint_lower=np.where(limited, model.jnt_range[joints, 0], -np.pi),
        joint_upper=np.where(limited, model.jnt_range[joints, 1], np.pi),
        stance_position=stance[:3],
        stance_orientation=stance[3:7],
        stance_joints=stance[places],
        **{key: value for key, value in drives.items() if value.any()},
        joint_names=tuple(model.body(body).name.rsplit("_", 1)[-1] for body in bodies[0]),
        joints_in_file=tuple(zip(limb_names, in_file, strict=True)),
        spring=spring if spring.any() else None,
        spring_rest=model.qpos_spring[places] if spring.any() else None,
        torque_limit=limit if np.isfinite(limit).any() else None,
        slides=_flags(model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_SLIDE),
        passive=_flags(model.jnt_group[joints] == PASSIVE),
    )


def _frames(model: mujoco.MjModel, bodies: np.ndarray) -> dict[str, np.ndarray]:
    """Return frames, centres and inertias of links (limb, joint), and the feet, as fields of a `Robot`."""
    data = mujoco.MjData(model)
    data.qpos[:] = 0
    data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
    mujoco.mj_kinematics(model, data)

    def inertia(body: int, axes: np.ndarray) -> np.ndarray:
        """Return the moments of inertia about the centre of mass in the axes of a frame."""
        principal_axes = axes.T @ data.ximat[body].reshape(3, 3)
        return np.asarray(principal_axes @ np.diag(model.body_inertia[body]) @ principal_axes.T)

    def exact(value: np.ndarray) -> np.ndarray:
        """Return 0, 1 and -1 where rounding has missed them: a kernel leaves out products with these."""
        whole = value.round()
        return np.where((np.abs(value - whole) < 1e-14) & (np.abs(whole) < 2), whole + 0.0, value)  # no -0.0

    links, feet = [], []
    for limb, chain in enumerate(bodies):
        at, axes = np.zeros(3), np.eye(3)  # of the parent
        for body in chain:
            parent, anchor, axis = axes, data.xanchor[body - 1], data.xaxis[body - 1]
            own = data.xmat[body].reshape(3, 3)
            axes = frame_along(axis, own[:, np.argmin(np.abs(own.T @ axis).round(6))])
            placed = (parent.T @ (anchor - at), parent.T @ axes, axes.T @ (data.xipos[body] - anchor))
            links.append((*map(exact, placed), inertia(body, axes)))
            at = anchor
        feet.append(axes.T @ (data.site_xpos[limb] - at))
    fields = ("frame_position", "frame_rotation", "link_center", "link_inertia")
    values = (np.reshape(each, (*bodies.shape, *each[0].shape)) for each in zip(*links, strict=True))
    base = {"foot_center": np.array(feet), "base_inertia": inertia(1, np.eye(3))}
    return base | dict(zip(fields, values, strict=True))
