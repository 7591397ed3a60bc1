"""A robot whose file begins at a foot, turned round so that it begins at the base."""

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot.description import RobotError, bare, compiled, one_limit
from mjx_climb.robot.found_limbs import at_zero


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
    if model.neq:
        raise RobotError(f"{file}: robot.base: expected a file without equality constraints, got {model.neq}")
    return compiled(file, rerooted(model, base))


def rerooted(model: mujoco.MjModel, base: str) -> mujoco.MjSpec:
    """Return a robot with another of its bodies as the root: masses, joints and sites, no shapes.

    With the joints at zero all bodies are where they were; a joint that is passed the other way round turns about the
    opposite axis, so that its angle stays what it was. Joints between the old root and the world are left out.
    """
    data, spec = at_zero(model), mujoco.MjSpec()
    spec.compiler.degree = False
    first = model.body(base).id
    todo = [(first, 0, spec.worldbody, np.zeros(3), np.eye(3))]
    while todo:
        body, before, parent, origin, axes = todo.pop()
        place, turn = data.xpos[body], data.xmat[body].reshape(3, 3)
        made = parent.add_body(
            name=model.body(body).name, pos=axes.T @ (place - origin), quat=quaternion(axes.T @ turn)
        )
        made.explicitinertial = True
        made.mass, made.ipos, made.iquat = model.body_mass[body], model.body_ipos[body], model.body_iquat[body]
        made.inertia = model.body_inertia[body]
        outwards = model.body_parentid[body] == before
        between = () if body == first else _joints(model, body) if outwards else _joints(model, before)[::-1]
        for joint in between:
            moved = add_joint(made, model, joint, model.joint(joint).name)
            moved.pos = turn.T @ (data.xanchor[joint] - place)
            moved.axis = (1.0 if outwards else -1.0) * (turn.T @ data.xaxis[joint])
        for site in np.flatnonzero(model.site_bodyid == body):
            if model.site(site).name:
                made.add_site(name=model.site(site).name, pos=model.site_pos[site], quat=model.site_quat[site])
        around = [*np.flatnonzero(model.body_parentid == body), model.body_parentid[body]]
        todo += [(int(other), body, made, place, turn) for other in around if other not in (0, before, body)]
    return spec


def _joints(model: mujoco.MjModel, body: int) -> list[int]:
    return [int(model.body_jntadr[body]) + n for n in range(model.body_jntnum[body])]


def add_joint(body: mujoco.MjsBody, model: mujoco.MjModel, joint: int, name: str) -> mujoco.MjsJoint:
    """Add to a body a joint with the drive, spring and limits of one of a model, and return it."""
    dof = model.jnt_dofadr[joint]
    made = body.add_joint(
        name=name,
        type=mujoco.mjtJoint(model.jnt_type[joint]),
        armature=model.dof_armature[dof],
        damping=[model.dof_damping[dof], 0, 0],
        frictionloss=model.dof_frictionloss[dof],
        stiffness=[model.jnt_stiffness[joint], 0, 0],
        springref=model.qpos_spring[model.jnt_qposadr[joint]],
    )
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
