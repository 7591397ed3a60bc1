"""A robot's own MJCF or URDF as its author wrote it, without what the dynamics do not need."""

import re
import warnings
from pathlib import Path

import numpy as np

from mjx_climb.mujoco_import import mujoco

JOINTS = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
PASSIVE = 1  # group of the joints that nothing drives, in the models simulated here
FILLING = 2  # group of the joints that only fill up a limb of fewer joints than others
SPECK = 1e-10  # kg, kg m^2: of links without a mass, as many a file has them between two joints
_ROUNDING = 1e-6  # of the largest moment of inertia
_DROPPED = ("actuators", "sensors", "pairs", "excludes", "skins", "tendons", "cameras", "lights", "flexes", "hfields")


class RobotError(ValueError):
    """A model that mjx_climb cannot use: the message names the model and what was expected."""


def described(file: str) -> mujoco.MjSpec:
    """Return the description in a file, with a name for every body and joint and hinges in place of ball joints.

    A body without a name is called after its parent and its place among the children, a joint after its body. A ball
    joint `hip` becomes hinges `hip_x`, `hip_y`, `hip_z` about the body's own axes.

    Raises:
        RobotError: a file that MuJoCo does not read, or numbers that no joint and no body can have.
    """
    mujoco.set_mju_user_warning(lambda message: None)  # what is wrong is said once, by what is raised
    try:
        spec = mujoco.MjSpec.from_file(file)
    except (ValueError, OSError, mujoco.FatalError) as error:
        raise unreadable(file, error) from None
    finally:
        mujoco.set_mju_user_warning(None)
    _possible(file, spec)
    taken = {body.name for body in spec.bodies}
    for body in spec.bodies:
        for number, child in enumerate(body.bodies):
            if not child.name:
                child.name = _free(f"{body.name}_{number + 1}", taken)
    taken = {joint.name for joint in spec.joints}
    for body in spec.bodies:
        for joint in body.joints:
            if not joint.name:
                joint.name = _free(
                    body.name if joint.type != mujoco.mjtJoint.mjJNT_FREE else f"{body.name}_free", taken
                )
    balls = [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_BALL]
    for ball in balls:
        _as_hinges(spec, ball)
    if balls:
        for key in spec.keys:
            spec.delete(key)
    return spec


def _possible(file: str, spec: mujoco.MjSpec) -> None:
    """Refuse what MuJoCo takes for something else: limits the wrong way round for none, a mass below zero for none."""
    urdf = file.lower().endswith(".urdf")
    for joint in spec.joints:
        lower, upper = joint.range
        numbers = {"armature": joint.armature, "damping": joint.damping[0], "stiffness": joint.stiffness[0],
                   "frictionloss": joint.frictionloss}  # fmt: skip
        if lower > upper and (urdf or joint.limited != mujoco.mjtLimited.mjLIMITED_FALSE):
            expected, got = "limits in ascending order", f"{lower:g} to {upper:g}"
        elif below := [name for name, value in numbers.items() if value < 0]:
            expected, got = f"{below[0]} of zero or more", f"{numbers[below[0]]:g}"
        else:
            continue
        raise RobotError(f"{line_of(file, joint.name)}: joint {joint.name!r}: expected {expected}, got {got}")
    for body in spec.bodies:
        if not body.explicitinertial:
            continue
        if body.mass < 0 or (np.isfinite(body.inertia).all() and min(body.inertia) < 0):
            got = f"{body.mass:g} kg, {', '.join(f'{moment:g}' for moment in body.inertia)} kg m^2"
            place = line_of(file, body.name)
            raise RobotError(f"{place}: link {body.name!r}: expected a mass and moments of zero or more, got {got}")


def _free(name: str, taken: set[str]) -> str:
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def _as_hinges(spec: mujoco.MjSpec, ball: mujoco.MjsJoint) -> None:
    """Put three hinges in the place of a ball joint."""
    limit = float(ball.range[1]) if ball.range[1] > 0 else 0.0
    how = dict(pos=ball.pos, stiffness=ball.stiffness, damping=ball.damping, armature=ball.armature)
    name, parent, limited = ball.name, ball.parent, ball.limited
    spec.delete(ball)
    for letter, axis in zip("xyz", np.eye(3), strict=True):
        hinge = parent.add_joint(name=f"{name}_{letter}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis, **how)
        hinge.limited = limited
        if limit:
            hinge.range = [-limit, limit]


def bare(file: str) -> mujoco.MjSpec:
    """Return the description in a file without shapes of weighed bodies, looks, actuators, sensors and tendons.

    A URDF has its inertias written down, and so have many an MJCF's bodies: their shapes, and the files of meshes, do
    not matter. Moments of inertia that no body can have are made equal, as MuJoCo does (`balanceinertia`), and links
    without a mass get a speck of one.

    Raises:
        RobotError: a file that MuJoCo does not read.
    """
    spec = described(file)
    urdf = file.lower().endswith(".urdf")
    _limit_torques(spec)
    for kind in _DROPPED:
        for part in getattr(spec, kind):
            spec.delete(part)
    for key in spec.keys:
        key.ctrl, key.act = [], []
    for equality in spec.equalities:
        if equality.type == mujoco.mjtEq.mjEQ_TENDON:
            spec.delete(equality)
    for body in spec.bodies:
        _mend(body)
    lowest, highest = spec.compiler.inertiagrouprange
    from_shapes = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    for geom in spec.geoms:
        weighed = urdf or (geom.parent.explicitinertial and not from_shapes) or geom.parent.name == "world"
        if weighed or geom.mass == 0 or geom.density == 0 or not lowest <= geom.group <= highest:
            spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms}
    for drawn in (*spec.geoms, *spec.sites):
        drawn.material = ""
    for part in (*(mesh for mesh in spec.meshes if mesh.name not in used), *spec.materials, *spec.textures):
        spec.delete(part)
    spec.compiler.fusestatic = False
    spec.compiler.boundmass = spec.compiler.boundinertia = SPECK
    return spec


def impossible(body: mujoco.MjsBody) -> bool:
    """Return whether no body can have these moments of inertia: a principal one is above the sum of the others."""
    moments = _moments(body)
    least, middle, most = np.linalg.eigvalsh(moments)
    return bool(most > SPECK and np.diag(moments).min() >= 0 and least + middle < (1 - _ROUNDING) * most)


def _mend(body: mujoco.MjsBody) -> None:
    """Make moments equal that no body can have, and lift those of points, rods and plates off what MuJoCo refuses."""
    if not body.explicitinertial:
        return
    moments = _moments(body)
    least, middle, most = np.linalg.eigvalsh(moments)
    if np.abs(moments).max() <= SPECK:
        mended = SPECK * np.eye(3)
    elif impossible(body):
        mended = np.eye(3) * np.trace(moments) / 3
    elif least >= -_ROUNDING * most and (least <= 0 or least + middle < most):
        mended = moments + 2 * _ROUNDING * most * np.eye(3)
    else:
        return
    if np.isfinite(body.fullinertia[0]):
        body.fullinertia = [*np.diag(mended), mended[0, 1], mended[0, 2], mended[1, 2]]
    else:
        body.inertia = np.diag(mended)


def _moments(body: mujoco.MjsBody) -> np.ndarray:
    """Return the written inertia of a body, (3, 3) kg m^2; zeros where there is none."""
    if not body.explicitinertial:
        return np.zeros((3, 3))
    xx, yy, zz, xy, xz, yz = body.fullinertia if np.isfinite(body.fullinertia[0]) else (*body.inertia, 0, 0, 0)
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return matrix if np.isfinite(matrix).all() else np.zeros((3, 3))


def _limit_torques(spec: mujoco.MjSpec) -> None:
    """Write what the actuators can give into the joints that they turn, where these say nothing of their own."""
    for actuator in spec.actuators:
        joint = spec.joint(actuator.target) if actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT else None
        if joint is None or joint.actfrcrange[1] > 0:
            continue
        most = float(actuator.forcerange[1])
        direct = actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED and actuator.biastype == mujoco.mjtBias.mjBIAS_NONE
        if most <= 0 and direct:
            most = float(actuator.ctrlrange[1] * actuator.gainprm[0])
        most *= abs(float(actuator.gear[0]))
        if most > 0:
            joint.actfrcrange, joint.actfrclimited = [-most, most], mujoco.mjtLimited.mjLIMITED_TRUE


def compiled(file: str, spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Return the model of the description in a file.

    Raises:
        RobotError: one that MuJoCo does not compile.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what is old-fashioned in somebody's file
            return spec.compile()
    except (ValueError, OSError, mujoco.FatalError) as error:
        raise unreadable(file, error) from None


def unreadable(file: str, error: Exception) -> RobotError:
    """Return what MuJoCo says of a file in one line, beginning with the line of the file that it is about."""
    reason = " ".join((str(error) or "an empty one").split())
    place = file
    if found := re.search(r"[Ll]ine (?:number=)?(\d+)", reason):
        place = f"{file}:{found[1]}"
    elif found := re.search(r"[Ee]lement name '([^']+)'", reason):
        place = line_of(file, found[1])
    return RobotError(f"{place}: expected an MJCF or URDF that MuJoCo loads, got {reason[:300]}")


def line_of(file: str, name: str) -> str:
    """Return a file, and after a colon the line in which it first names an element so, if it does."""
    try:
        text = Path(file).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return file
    found = re.search(rf"name\s*=\s*[\"']{re.escape(name)}[\"']", text)
    return f"{file}:{text.count(chr(10), 0, found.start()) + 1}" if found else file
