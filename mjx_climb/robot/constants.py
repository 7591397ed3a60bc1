"""The robot as constants: what the equations need of an MJCF, in the layout of the hot path."""

import dataclasses
import functools
import os
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot.description import PASSIVE, RobotError
from mjx_climb.robot.robot_file import model_of, spec_of
from mjx_climb.scenario.model import RobotFile

__all__ = [
    "Robot",
    "RobotError",
    "load_model",
    "load_robot",
    "load_spec",
    "model_path",
    "robot_from_model",
]

_DRIVES = {"armature": "dof_armature", "damping": "dof_damping", "friction": "dof_frictionloss"}  # by MuJoCo's names
_KINDS = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=[
        "base_mass", "base_inertia", "link_mass", "link_center", "link_inertia", "frame_position", "frame_rotation",
        "foot_center", "joint_lower", "joint_upper", "stance_position", "stance_orientation", "stance_joints",
        "armature", "damping", "friction", "spring", "spring_rest", "torque_limit",
    ],
    meta_fields=["name", "limbs", "model", "slides", "passive", "joint_names"],
)  # fmt: skip
@dataclasses.dataclass(frozen=True)
class Robot:
    """A base with limbs of N joints each, revolute or prismatic: masses, frames and limits.

    Every link has a frame at its joint whose z axis is the joint's axis; with the joint at zero, `frame_rotation` and
    `frame_position` place it in its parent's frame. The base frame sits at the base's centre of mass. Axes: link (from
    the base outwards) before components, limbs (L) second to last, batch (1) last. SI units; a prismatic joint's values
    are in m where a revolute one's are in rad.
    """

    name: str
    limbs: tuple[str, ...]
    model: mujoco.MjModel  # what the numbers were read off
    base_mass: Float[np.ndarray, " #B"]  # kg
    base_inertia: Float[np.ndarray, "3 3 #B"]  # kg m^2, base frame
    link_mass: Float[np.ndarray, "N L #B"]  # kg
    link_center: Float[np.ndarray, "N 3 L #B"]  # m: [link, component], link frame
    link_inertia: Float[np.ndarray, "N 3 3 L #B"]  # kg m^2 about the link's centre of mass, link frame
    frame_position: Float[np.ndarray, "N 3 L #B"]  # m: [link, component], parent frame
    frame_rotation: Float[np.ndarray, "N 3 3 L #B"]  # [link, row, column]
    foot_center: Float[np.ndarray, "3 L #B"]  # m, frame of the last link
    joint_lower: Float[np.ndarray, "N L #B"]  # rad
    joint_upper: Float[np.ndarray, "N L #B"]  # rad
    stance_position: Float[np.ndarray, "3 #B"]  # m, world
    stance_orientation: Float[np.ndarray, "4 #B"]  # wxyz
    stance_joints: Float[np.ndarray, "N L #B"]  # rad
    armature: Float[np.ndarray, "N L #B"] | None = None  # kg m^2, of the drives, seen at the joints; None: none
    damping: Float[np.ndarray, "N L #B"] | None = None  # N m s/rad, of the joints, as the file says; None: none
    friction: Float[np.ndarray, "N L #B"] | None = None  # N m, dry, of the joints, as the file says; None: none
    spring: Float[np.ndarray, "N L #B"] | None = None  # N m/rad, of the joints, as the file says; None: none
    spring_rest: Float[np.ndarray, "N L #B"] | None = None  # rad, where the springs are slack
    torque_limit: Float[np.ndarray, "N L #B"] | None = None  # N m, of the drives, infinite: none; None: none at all
    slides: tuple[tuple[bool, ...], ...] = ()  # [link][limb]: the joint is prismatic; (): none is
    passive: tuple[tuple[bool, ...], ...] = ()  # [link][limb]: nothing drives the joint; (): all are driven
    joint_names: tuple[str, ...] = ()  # (N,) of a limb's joints, from the base outwards

    @property
    def joints(self) -> int:
        """Number of joints of each limb."""
        return len(self.frame_position)

    def sliding(self, link: int) -> np.ndarray | None:
        """Return which limbs have a prismatic joint at a link, (L, 1) bool; None where all are revolute."""
        return np.array(self.slides[link])[:, None] if self.slides and any(self.slides[link]) else None

    @property
    def driven(self) -> np.ndarray | None:
        """Which joints are driven, (N, L, 1) bool; None where all are."""
        return ~np.array(self.passive)[..., None] if self.passive else None

    @property
    def total_mass(self) -> Float[np.ndarray, " B"]:
        """Mass of base and links, kg."""
        mass: np.ndarray = self.base_mass + self.link_mass.sum((0, 1))
        return mass


def model_path(name: str | RobotFile) -> Path:
    """Return the file of a robot: a user's own, or the MJCF of one that comes with mjx_climb.

    Raises:
        RobotError: no such robot.
    """
    if isinstance(name, RobotFile):
        return Path(name.file)
    folder = Path(str(resources.files("mjx_climb"))) / "robot" / "models"
    path = folder / f"{name}.xml"
    if not os.path.isfile(path):
        known = ", ".join(sorted(p.stem for p in folder.glob("*.xml")))
        raise RobotError(f"robot: expected one of {known}, got {name!r}")
    return path


@functools.cache
def load_model(name: str | RobotFile) -> mujoco.MjModel:
    """Return the compiled MuJoCo model of a robot: one that comes with mjx_climb, or one from a file."""
    if isinstance(name, RobotFile):
        return model_of(name)
    return mujoco.MjModel.from_xml_path(str(model_path(name)))


def load_spec(name: str | RobotFile) -> mujoco.MjSpec:
    """Return the editable description that `load_model` compiles."""
    return spec_of(name) if isinstance(name, RobotFile) else mujoco.MjSpec.from_file(str(model_path(name)))


@functools.cache
def load_robot(name: str | RobotFile) -> Robot:
    """Return the constants of a robot, read off its MuJoCo model with the joints at zero.

    Raises:
        RobotError: no such robot, or a model other than a floating base with limbs of as many joints each and a foot.
    """
    return robot_from_model(load_model(name), name if isinstance(name, str) else Path(name.file).stem)


def _limb_bodies(model: mujoco.MjModel, name: str) -> list[list[int]]:
    """Return the body ids of each limb, from the base outwards, in the order of the model."""
    if model.nq < 7 or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        raise RobotError(f"{name}: expected a base on a free joint as the first body")
    limbs = []
    for first in np.flatnonzero(model.body_parentid == 1):
        chain = [int(first)]
        while len(children := np.flatnonzero(model.body_parentid == chain[-1])) == 1:
            chain.append(int(children[0]))
        one = all(model.body_jntnum[b] == 1 and int(model.jnt_type[model.body_jntadr[b]]) in _KINDS for b in chain)
        if len(children) or not one:
            raise RobotError(
                f"{name}: expected limbs that are chains of one hinge or slide a body, got body "
                f"{model.body(first).name!r}"
            )
        limbs.append(chain)
    lengths = {len(chain) for chain in limbs}
    if len(lengths) != 1 or model.nbody != 2 + sum(map(len, limbs)):
        got = f"{len(limbs)} limbs of {', '.join(map(str, sorted(lengths))) or 'no'} joints, {model.nbody - 1} bodies"
        raise RobotError(f"{name}: expected a base with limbs of as many joints each and no other bodies, got {got}")
    return limbs


def _frame(axis: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return a rotation matrix with z along `axis` and x as near to the columns of `reference` as that allows."""
    x = reference[:, np.argmin(np.abs(reference.T @ axis).round(6))]
    x = x - axis * (axis @ x)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def _exact(value: np.ndarray) -> np.ndarray:
    """Return an array with 0, 1 and -1 where rounding has missed them: a kernel leaves out what these multiply."""
    whole = value.round()
    return np.where((np.abs(value - whole) < 1e-14) & (np.abs(whole) < 2), whole, value)


def _flags(mask: np.ndarray) -> tuple[tuple[bool, ...], ...]:
    """Return a mask (N, L, 1) as tuples, empty where it is false throughout."""
    return tuple(map(tuple, mask[..., 0].tolist())) if mask.any() else ()


def robot_from_model(model: mujoco.MjModel, name: str) -> Robot:
    """Return the constants of a MuJoCo model: see `load_robot`."""
    limbs = _limb_bodies(model, name)
    data = mujoco.MjData(model)
    data.qpos[:] = 0
    data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
    mujoco.mj_kinematics(model, data)
    if np.abs(model.body_ipos[1]).max() > 1e-12:
        raise RobotError(
            f"{name}: expected the base frame at the base's centre of mass, got an offset {model.body_ipos[1]}"
        )

    def inertia(body: int, rotation: np.ndarray) -> np.ndarray:
        principal_axes = rotation.T @ data.ximat[body].reshape(3, 3)
        return np.asarray(principal_axes @ np.diag(model.body_inertia[body]) @ principal_axes.T)

    keys = (
        "mass",
        "center",
        "inertia",
        "position",
        "rotation",
        "foot",
        "lower",
        "upper",
        "slides",
        "passive",
        *_DRIVES,
    )
    keys += ("spring", "rest", "limit")
    fields: dict[str, list[np.ndarray]] = {key: [] for key in keys}
    for chain in limbs:
        parent_position, parent_rotation = np.zeros(3), np.eye(3)
        column: dict[str, Any] = {key: [] for key in keys}
        for body in chain:
            joint = model.body_jntadr[body]
            position = data.xanchor[joint]
            rotation = _frame(data.xaxis[joint], data.xmat[body].reshape(3, 3))
            column["mass"].append(model.body_mass[body])
            column["center"].append(rotation.T @ (data.xipos[body] - position))
            column["inertia"].append(inertia(body, rotation))
            column["position"].append(_exact(parent_rotation.T @ (position - parent_position)))
            column["rotation"].append(_exact(parent_rotation.T @ rotation))
            column["lower"].append(model.jnt_range[joint, 0] if model.jnt_limited[joint] else -np.pi)
            column["upper"].append(model.jnt_range[joint, 1] if model.jnt_limited[joint] else np.pi)
            for key, field in _DRIVES.items():
                column[key].append(getattr(model, field)[model.jnt_dofadr[joint]])
            column["slides"].append(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE)
            column["passive"].append(model.jnt_group[joint] == PASSIVE)
            column["spring"].append(model.jnt_stiffness[joint])
            column["rest"].append(model.qpos_spring[model.jnt_qposadr[joint]])
            column["limit"].append(model.jnt_actfrcrange[joint, 1] if model.jnt_actfrclimited[joint] else np.inf)
            parent_position, parent_rotation = position, rotation
        sites = np.flatnonzero(model.site_bodyid == chain[-1])
        if len(sites) != 1:
            raise RobotError(f"{name}: expected one foot site on {model.body(chain[-1]).name!r}, got {len(sites)}")
        column["foot"] = parent_rotation.T @ (data.site_xpos[sites[0]] - parent_position)
        for key, value in column.items():
            fields[key].append(np.asarray(value))
    if model.nkey < 1:
        raise RobotError(f"{name}: expected a keyframe with the rest stance")
    stance = model.key_qpos[0]
    stacked = {key: np.stack(value, axis=-1)[..., None] for key, value in fields.items()}
    sprung = stacked["spring"].any()
    return Robot(
        name=name,
        limbs=tuple(model.body(chain[0]).name.rsplit("_", 1)[0] for chain in limbs),
        model=model,
        base_mass=model.body_mass[1:2].copy(),
        base_inertia=inertia(1, np.eye(3))[..., None],
        link_mass=stacked["mass"],
        link_center=stacked["center"],
        link_inertia=stacked["inertia"],
        frame_position=stacked["position"],
        frame_rotation=stacked["rotation"],
        foot_center=stacked["foot"],
        joint_lower=stacked["lower"],
        joint_upper=stacked["upper"],
        stance_position=stance[:3, None].copy(),
        stance_orientation=stance[3:7, None].copy(),
        stance_joints=stance[7:].reshape(len(limbs), -1).T[..., None].copy(),
        **{key: stacked[key] if stacked[key].any() else None for key in _DRIVES},
        joint_names=tuple(model.body(body).name.rsplit("_", 1)[-1] for body in limbs[0]),
        spring=stacked["spring"] if sprung else None,
        spring_rest=stacked["rest"] if sprung else None,
        torque_limit=stacked["limit"] if np.isfinite(stacked["limit"]).any() else None,
        slides=_flags(stacked["slides"]),
        passive=_flags(stacked["passive"]),
    )
