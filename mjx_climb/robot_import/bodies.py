"""Bodies and joints of the robot in a file; a file that begins at a foot is turned round: it begins at the base."""

import itertools
from collections.abc import Mapping, Sequence, Set
from types import MappingProxyType

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot.constants import RobotError
from mjx_climb.robot_import.description import JOINTS, bare, compiled, one_limit


def rigid_parts(model: mujoco.MjModel, held: Set[int] = frozenset()) -> np.ndarray:
    """Return for each body the first body of the rigid part that it belongs to, where some joints are held."""
    part = np.arange(model.nbody)
    for body in range(1, model.nbody):
        parent = model.body_parentid[body]
        if parent != 0 and held >= set(joints_of(model, body)):
            part[body] = part[parent]
    return part


def joints_of(model: mujoco.MjModel, body: int) -> list[int]:
    """Return the joints of a body."""
    return [int(joint) for joint in np.flatnonzero(model.jnt_bodyid == body)]


def beginning(names: Sequence[list[str]]) -> list[str]:
    """Return the words with which all names begin."""
    alike = itertools.takewhile(lambda words: len(set(words)) == 1, zip(*names, strict=False))
    return [words[0] for words in alike]


def at_zero(model: mujoco.MjModel, held: Mapping[int, float] = MappingProxyType({})) -> mujoco.MjData:
    """Return the robot with its joints at zero, but for those that are held."""
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[np.isin(model.jnt_type, JOINTS)]] = 0
    data.qpos[model.jnt_qposadr[list(held)]] = list(held.values())
    mujoco.mj_kinematics(model, data)
    return data


def foot_of(model: mujoco.MjModel, data: mujoco.MjData, foot: str, at: Sequence[float]) -> np.ndarray:
    """Return where a foot is, (3,) m in world axes: `at` m in the frame of the site or body that is called so."""
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, foot)
    place = data.site(site) if site >= 0 else data.body(foot)
    return np.asarray(place.xpos + place.xmat.reshape(3, 3) @ np.array(at))


def robot_in(file: str, base: str | None = None) -> mujoco.MjModel:
    """Return the robot in a file, with `base` as its root where that is given.

    Raises:
        RobotError: a file that MuJoCo does not load, or no such body.
    """
    model = compiled(file, bare(file))
    if base is None:
        return model
    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, base) < 1:
        known = ", ".join(model.body(body).name for body in range(1, model.nbody)) or "none"
        raise RobotError(f"{file}: robot.base: expected a body of the file ({known[:200]}), got {base!r}")
    return compiled(file, rerooted(model, base))


def rerooted(model: mujoco.MjModel, base: str) -> mujoco.MjSpec:
    """Return a robot with another of its bodies as the root: masses, joints, sites and constraints, no shapes.

    With the joints at zero all bodies are where they were; a joint that is passed the other way round turns about the
    opposite axis, so that its angle stays. Joints between the old root and the world are left out.
    """
    data, spec = at_zero(model), mujoco.MjSpec()
    spec.compiler.degree = False
    first = model.body(base).id
    todo = [(first, 0, spec.worldbody, np.zeros(3), np.eye(3))]
    while todo:
        body, before, parent, origin, axes = todo.pop()
        place, turn = data.xpos[body], data.xmat[body].reshape(3, 3)
        pose = {"pos": axes.T @ (place - origin), "quat": quaternion(axes.T @ turn)}
        made = parent.add_body(name=model.body(body).name, **pose, explicitinertial=True)
        made.mass, made.inertia = model.body_mass[body], model.body_inertia[body]
        made.ipos, made.iquat = model.body_ipos[body], model.body_iquat[body]
        outwards = model.body_parentid[body] == before
        between = () if body == first else joints_of(model, body) if outwards else joints_of(model, before)[::-1]
        for joint in between:
            moved = add_joint(made, model, joint, model.joint(joint).name)
            moved.pos = turn.T @ (data.xanchor[joint] - place)
            moved.axis = (1.0 if outwards else -1.0) * (turn.T @ data.xaxis[joint])
        for site in np.flatnonzero(model.site_bodyid == body):
            if model.site(site).name:
                made.add_site(name=model.site(site).name, pos=model.site_pos[site], quat=model.site_quat[site])
        around = [*np.flatnonzero(model.body_parentid == body), model.body_parentid[body]]
        todo += [(int(other), body, made, place, turn) for other in around if other not in (0, before, body)]
    for constraint in range(model.neq):
        kind, of = mujoco.mjtEq(model.eq_type[constraint]), mujoco.mjtObj(model.eq_objtype[constraint])
        named = mujoco.mjtObj.mjOBJ_JOINT if kind == mujoco.mjtEq.mjEQ_JOINT else of
        ends = (model.eq_obj1id[constraint], model.eq_obj2id[constraint])
        name1, name2 = (mujoco.mj_id2name(model, named, end) or "" for end in ends)
        spec.add_equality(
            name=model.equality(constraint).name, type=kind, objtype=of, name1=name1, name2=name2,
            data=model.eq_data[constraint], active=bool(model.eq_active0[constraint]),
        )  # fmt: skip
    return spec


def add_joint(body: mujoco.MjsBody, model: mujoco.MjModel, joint: int, name: str) -> mujoco.MjsJoint:
    """Add to a body a joint with the drive, spring and limits of one of a model, and return it."""
    dof, made = model.jnt_dofadr[joint], body.add_joint(name=name, type=mujoco.mjtJoint(model.jnt_type[joint]))
    made.armature, made.frictionloss = model.dof_armature[dof], model.dof_frictionloss[dof]
    made.damping, made.stiffness = [model.dof_damping[dof], 0, 0], [model.jnt_stiffness[joint], 0, 0]
    made.springref = model.qpos_spring[model.jnt_qposadr[joint]]
    if model.jnt_limited[joint]:
        made.range, made.limited = model.jnt_range[joint], mujoco.mjtLimited.mjLIMITED_TRUE
    if model.jnt_actfrclimited[joint]:
        most = one_limit(*model.jnt_actfrcrange[joint])
        made.actfrcrange, made.actfrclimited = [-most, most], mujoco.mjtLimited.mjLIMITED_TRUE
    return made


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternion (4,) wxyz of a rotation matrix (3, 3)."""
    found = np.empty(4)
    mujoco.mju_mat2Quat(found, rotation.ravel())
    return found
