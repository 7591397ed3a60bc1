"""A user's own robot: from her MJCF or URDF and the joints and feet that she names, to the model simulated here."""

import itertools
import re
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot.description import FILLING, JOINTS, PASSIVE, SPECK, RobotError, one_limit
from mjx_climb.robot.places import line_of
from mjx_climb.robot.posture import limb_joints
from mjx_climb.robot.rerooted import robot_in
from mjx_climb.scenario.model import Limb, RobotFile

SNAP = 1e-4  # rad: axes as near as this to parallel or square are meant so; many a URDF has pi / 2 as 1.5708
REACH = 1.0  # m, of a sliding joint without limits, either way
_NO_INERTIA = np.zeros((3, 3))
_SHORT = 1e-3  # m, links too short to draw
_PAD = (1e-9, 1e-12)  # kg, kg m^2: of a joint that only fills up a limb of fewer joints than others, at its foot


class _Link(NamedTuple):
    """A rigid part: its bodies are those between one joint and the next. World axes, joints at zero."""

    mass: float  # kg
    center: np.ndarray  # (3,) m
    inertia: np.ndarray  # (3, 3) kg m^2 about the centre


def model_of(source: RobotFile) -> mujoco.MjModel:
    """Return the model of a robot file, as `spec_of` describes it."""
    return compiled_robot(source, spec_of(source))


def spec_of(source: RobotFile) -> mujoco.MjSpec:
    """Return a robot file as simulated: floating base, limbs of as many joints each, foot sites, rest stance.

    The base frame has the axes of the file's base link and sits at the base's centre of mass. Only masses, joints with
    the armature, damping and dry friction of their drives, and feet are taken over; the bodies are drawn as plain
    shapes. Limbs come counter-clockwise, seen from above, by where their feet stand. One of fewer joints than others is
    filled up with joints at its foot that move nothing.

    Raises:
        RobotError: in one line, the key of the config, what was expected and what the file has.
    """
    spec, offset = unposed(source)
    _stand(source, spec, offset)
    return spec


def unposed(source: RobotFile) -> tuple[mujoco.MjSpec, np.ndarray]:
    """Return the robot of `spec_of` before it stands, and its base's centre of mass in its link's frame, (3,) m."""
    file = robot_in(source.file, source.base)
    locked = _locked(source, file)
    data = mujoco.MjData(file)
    data.qpos[file.jnt_qposadr[np.isin(file.jnt_type, JOINTS)]] = 0
    data.qpos[file.jnt_qposadr[list(locked)]] = list(locked.values())
    mujoco.mj_kinematics(file, data)
    part = _parts(file, locked)
    limbs = _around(source)
    chains = {name: _chain(source, file, part, locked, name, limb) for name, limb in limbs.items()}
    base = _base(source, file, part, locked, chains)
    _no_more(source, file, part, base, chains, locked)
    _sprung(source, file, chains)
    axes = data.xmat[base].reshape(3, 3)
    body = _link(file, data, np.flatnonzero(part == base))
    if not body.mass:
        raise _error(source, "file", f"a mass of the base link {file.body(base).name!r}", "none", file.body(base).name)

    spec = _scene()
    trunk = spec.worldbody.add_body(name="base")
    trunk.add_freejoint(name="base")
    _weigh(trunk, body._replace(center=np.zeros(3), inertia=axes.T @ body.inertia @ axes))
    _box(trunk, np.array([_base_anchor(data, chain, axes, body) for chain in chains.values()]))
    names = _joint_names([limb.joints for limb in limbs.values()])
    for limb, chain in chains.items():
        _add_limb(source, trunk, limb, chain, names, file, data, part, axes, body.center)
    return spec, axes.T @ (body.center - data.xpos[base])


def _error(source: RobotFile, key: str, expected: str, got: str, element: str | None = None) -> RobotError:
    """Return what is wrong in one line, with that of the file where an element of that name stands."""
    place = source.file if element is None else line_of(source.file, element)
    return RobotError(" ".join(f"{place}: robot.{key}: expected {expected}, got {got}".split()))


def _around(source: RobotFile) -> dict[str, Limb]:
    """Return the limbs counter-clockwise from straight ahead, as the stability margins need them."""
    angle = {name: np.arctan2(*limb.foothold[::-1]) % (2 * np.pi) for name, limb in source.limbs.items()}
    return dict(sorted(source.limbs.items(), key=lambda item: angle[item[0]]))


def _locked(source: RobotFile, file: mujoco.MjModel) -> dict[int, float]:
    """Return the joints that are held, and at what."""
    held = {}
    for name, value in source.locked.items():
        joint = mujoco.mj_name2id(file, mujoco.mjtObj.mjOBJ_JOINT, name)
        if joint < 0 or file.jnt_type[joint] not in JOINTS:
            raise _error(source, f"locked.{name}", "a revolute or prismatic joint of the file", "none of that name")
        held[joint] = value
    return held


def _parts(file: mujoco.MjModel, locked: Collection[int]) -> np.ndarray:
    """Return for each body the first body of the rigid part that it belongs to."""
    part = np.arange(file.nbody)
    for body in range(1, file.nbody):
        parent, first = file.body_parentid[body], file.body_jntadr[body]
        free = set(range(first, first + file.body_jntnum[body])) - set(locked)
        if not free and parent != 0:
            part[body] = part[parent]
    return part


def _inner(file: mujoco.MjModel, part: np.ndarray, locked: Collection[int], joint: int) -> tuple[int, int]:
    """Return the joint that a joint hangs on, -1 for none, and the body that it does."""
    body = int(file.jnt_bodyid[joint])
    parent = int(part[file.body_parentid[body]])

    def moving(of: int, until: int) -> list[int]:
        first = int(file.body_jntadr[of])
        return [j for j in range(first, until) if j not in locked and int(file.jnt_type[j]) in JOINTS]

    if before := moving(body, joint):
        return before[-1], body
    inside = moving(parent, int(file.body_jntadr[parent] + file.body_jntnum[parent]))
    return (inside[-1] if inside else -1), parent


def _chain(
    source: RobotFile, file: mujoco.MjModel, part: np.ndarray, locked: Collection[int], name_of_limb: str, limb: Limb
) -> list[int]:
    """Return the joints of a limb, after a look at what they hang on."""
    key, joints = f"limbs.{name_of_limb}.joints", []
    for name in limb.joints:
        joint = mujoco.mj_name2id(file, mujoco.mjtObj.mjOBJ_JOINT, name)
        if joint < 0 or file.jnt_type[joint] not in JOINTS:
            known = ", ".join(file.joint(i).name for i in range(file.njnt)) or "none"
            raise _error(source, key, f"revolute or prismatic joints of the file ({known[:200]})", repr(name))
        if joint in locked:
            raise _error(source, f"locked.{name}", "a joint of no limb", f"one of {name_of_limb}", name)
        joints.append(joint)
    for inner, outer in itertools.pairwise(joints):
        if _inner(file, part, locked, outer)[0] != inner:
            name = file.joint(outer).name
            got = f"{name!r} not next after {file.joint(inner).name!r}"
            raise _error(source, key, "a chain from the base outwards", got, name)
    return joints


def _base(
    source: RobotFile, file: mujoco.MjModel, part: np.ndarray, locked: Collection[int], chains: dict[str, list[int]]
) -> int:
    """Return the body that all limbs begin at."""
    begins = {limb: _inner(file, part, locked, chain[0]) for limb, chain in chains.items()}
    first, (_, base) = next(iter(begins.items()))
    for limb, (joint, other) in begins.items():
        if other != base or base == 0 or joint >= 0:
            expected = f"all limbs to begin at one base link, as {first} does at {file.body(base).name!r}"
            name = file.joint(chains[limb][0]).name
            raise _error(source, f"limbs.{limb}.joints", expected, repr(file.body(other).name), name)
    return base


def _no_more(
    source: RobotFile,
    file: mujoco.MjModel,
    part: np.ndarray,
    base: int,
    chains: dict[str, list[int]],
    locked: Collection[int],
) -> None:
    """Refuse a robot with more to it than a base, its limbs, and joints that are held."""
    ours = [joint for chain in chains.values() for joint in chain]
    if len(set(ours)) != len(ours):
        twice = file.joint(next(joint for joint in ours if ours.count(joint) > 1)).name
        raise _error(source, "limbs", "different joints", f"{twice!r} twice", twice)
    for joint in range(file.njnt):
        body = file.jnt_bodyid[joint]
        floats = file.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE and body == base
        of_another = file.body_rootid[body] != file.body_rootid[base]
        if joint not in ours and joint not in locked and not floats and not of_another:
            name = file.joint(joint).name
            expected = f"no joints but those named and the base's own (robot.locked.{name}: 0 would hold it)"
            raise _error(source, "limbs", expected, repr(name), name)
    joints, root = mujoco.mjtEq.mjEQ_JOINT, file.body_rootid[base]
    for n in range(file.neq):
        if not file.eq_active0[n]:
            continue
        ends = [int(end) for end in (file.eq_obj1id[n], file.eq_obj2id[n]) if end >= 0]
        kind, holds = file.eq_type[n], file.eq_objtype[n] == mujoco.mjtObj.mjOBJ_BODY
        if kind == joints:
            idle = all(end in locked or file.body_rootid[file.jnt_bodyid[end]] != root for end in ends)
        else:
            idle = holds and (len({part[end] for end in ends}) == 1 or all(file.body_rootid[e] != root for e in ends))
        if not idle:
            name = file.equality(n).name or (file.joint(ends[0]).name if kind == joints else "") or (
                file.body(ends[0]).name if holds else "")  # fmt: skip
            raise _error(source, "file", "no equality constraints between moving parts", f"one at {name!r}", name)


def _sprung(source: RobotFile, file: mujoco.MjModel, chains: dict[str, list[int]]) -> None:
    """Refuse springs of joints that no limb has, and limbs that nothing drives."""
    springs = dict(source.springs.items())
    names = {limb: [file.joint(joint).name for joint in chain] for limb, chain in chains.items()}
    ours = {name for chain in names.values() for name in chain}
    for name in springs:
        if name not in ours:
            raise _error(source, f"springs.{name}", "a joint of a limb", "one of none", name)
    for limb, chain in names.items():
        if all(name in springs for name in chain):
            raise _error(source, f"limbs.{limb}.joints", "a joint that is driven", "springs in all", chain[0])


def _link(file: mujoco.MjModel, data: mujoco.MjData, bodies: np.ndarray) -> _Link:
    """Return several bodies as one, those without a mass left out."""
    weighed = bodies[file.body_mass[bodies] > SPECK]
    if not len(weighed):
        return _Link(0.0, data.xpos[bodies[0]].copy(), _NO_INERTIA)
    mass = file.body_mass[weighed]
    total = mass.sum()
    center = mass @ data.xipos[weighed] / total
    inertia = np.zeros((3, 3))
    for body in weighed:
        axes, r = data.ximat[body].reshape(3, 3), data.xipos[body] - center
        inertia += axes @ np.diag(file.body_inertia[body]) @ axes.T
        inertia += file.body_mass[body] * (r @ r * np.eye(3) - np.outer(r, r))
    return _Link(float(total), center, inertia)


def _foot(
    source: RobotFile, file: mujoco.MjModel, data: mujoco.MjData, part: np.ndarray, limb: str, last: int
) -> np.ndarray:
    """Return the foot of a limb, in world axes: a site or a body fixed to the last link."""
    name, at = dict(source.limbs.items())[limb].foot, np.array(dict(source.limbs.items())[limb].at)
    site = mujoco.mj_name2id(file, mujoco.mjtObj.mjOBJ_SITE, name)
    body = file.site_bodyid[site] if site >= 0 else mujoco.mj_name2id(file, mujoco.mjtObj.mjOBJ_BODY, name)
    if body < 0:
        raise _error(source, f"limbs.{limb}.foot", "a site, body or link of the file", repr(name))
    if part[body] != file.jnt_bodyid[last]:
        got = f"{name!r}, which is not fixed to it"
        raise _error(source, f"limbs.{limb}.foot", f"a place on the link of joint {file.joint(last).name!r}", got)
    position, axes = (data.site_xpos[site], data.site_xmat[site]) if site >= 0 else (data.xpos[body], data.xmat[body])
    return np.asarray(position + axes.reshape(3, 3) @ at)


def _axes(file: mujoco.MjModel, data: mujoco.MjData, chain: list[int]) -> list[np.ndarray]:
    """Return the axes of a limb's joints; those of a yaw and two pitches that nearly are, exactly so.

    For them the inverse kinematics has a closed form.
    """
    axes = list(data.xaxis[chain])
    if len(axes) != 3 or (file.jnt_type[chain] != mujoco.mjtJoint.mjJNT_HINGE).any():
        return axes
    coxa, femur, tibia = axes
    if abs(coxa @ femur) > SNAP or np.linalg.norm(np.cross(femur, tibia)) > SNAP:
        return axes
    femur = femur - coxa * (coxa @ femur)
    femur = femur / np.linalg.norm(femur)
    return [coxa, femur, np.sign(femur @ tibia) * femur]


def _limits(source: RobotFile, file: mujoco.MjModel, limb: str, joint: int) -> tuple[float, float]:
    slides = file.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
    if not file.jnt_limited[joint]:
        return (-REACH, REACH) if slides else (-np.pi, np.pi)
    lower, upper = file.jnt_range[joint]
    if not lower < upper:
        name = file.joint(joint).name
        expected = f"limits of {name!r} in ascending order"
        raise _error(source, f"limbs.{limb}.joints", expected, f"{lower:g} to {upper:g}", name)
    if not slides and upper - lower > 2 * np.pi and lower <= -np.pi and upper >= np.pi:
        return -np.pi, np.pi  # as free as a joint without limits
    return float(lower), float(upper)


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, rotation.ravel())
    return quaternion


def _weigh(body: mujoco.MjsBody, link: _Link) -> None:
    body.explicitinertial = True
    body.mass, body.ipos = link.mass, link.center
    i = link.inertia
    body.fullinertia = [i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]]


def _joint_names(limbs: Sequence[Sequence[str]]) -> list[str]:
    """Return names of the joints from the base outwards: the file's, without what tells its limbs apart.

    LF_hip_joint, LF_knee_joint, RF_hip_joint and RF_knee_joint are hip and knee. Where nothing is left, or names are
    alike, joint1, joint2 and so on.
    """

    def beginning(names: Sequence[list[str]]) -> list[str]:
        alike = itertools.takewhile(lambda words: len(set(words)) == 1, zip(*names, strict=False))
        return [words[0] for words in alike]

    def shared(names: Sequence[list[str]]) -> tuple[list[str], list[str]]:
        """Return with which words all of the names begin, and with which they end."""
        head = beginning(names)
        return head, beginning([name[len(head) :][::-1] for name in names])[::-1]

    places = [[re.split(r"[\W_]+", name) for name in place if name] for place in itertools.zip_longest(*limbs)]
    words = [list(itertools.chain(*shared(place))) for place in places]
    head, tail = shared(words)
    names = [" ".join(place[len(head) : len(place) - len(tail)]) for place in words]
    told_apart = len(set(names)) == len(names) and all(re.search("[A-Za-z]", name) for name in names)
    return names if told_apart else [f"joint{n + 1}" for n in range(len(places))]


def _add_limb(
    source: RobotFile,
    trunk: mujoco.MjsBody,
    limb: str,
    chain: list[int],
    names: Sequence[str],
    file: mujoco.MjModel,
    data: mujoco.MjData,
    part: np.ndarray,
    parent_axes: np.ndarray,
    parent_origin: np.ndarray,
) -> None:
    """Add one limb to the base; the frame of each link sits at its joint, z along the axis, x towards the next."""
    foot = _foot(source, file, data, part, limb, chain[-1])
    springs, stands = dict(source.springs.items()), [file.jnt_bodyid[joint] for joint in chain]
    links = [
        _link(file, data, np.flatnonzero(part == body)) if body not in stands[n + 1 :] else _Link(0.0, at, _NO_INERTIA)
        for n, (body, at) in enumerate(zip(stands, data.xanchor[chain], strict=True))
    ]
    anchors = [data.xanchor[joint] for joint in chain]
    body, ends = trunk, [*anchors[1:], foot]
    for n, (joint, axis, origin, end) in enumerate(zip(chain, _axes(file, data, chain), anchors, ends, strict=True)):
        axes = _frame(axis, end - origin)
        body = body.add_body(
            name=f"{limb}_{names[n]}",
            pos=parent_axes.T @ (origin - parent_origin),
            quat=_quaternion(parent_axes.T @ axes),
        )
        dof, name = file.jnt_dofadr[joint], file.joint(joint).name
        spring = springs.get(name)
        moved = body.add_joint(
            name=f"{limb}_{names[n]}",
            type=mujoco.mjtJoint(file.jnt_type[joint]),
            axis=[0, 0, 1],
            range=_limits(source, file, limb, joint),
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
            armature=file.dof_armature[dof],
            damping=[file.dof_damping[dof] + (spring.damping if spring else 0.0), 0, 0],
            frictionloss=file.dof_frictionloss[dof],
            stiffness=[spring.stiffness if spring else file.jnt_stiffness[joint], 0, 0],
            springref=spring.rest if spring else file.qpos_spring[file.jnt_qposadr[joint]],
            group=PASSIVE if spring else 0,
        )
        if file.jnt_actfrclimited[joint]:
            most = one_limit(*file.jnt_actfrcrange[joint])
            moved.actfrcrange, moved.actfrclimited = [-most, most], mujoco.mjtLimited.mjLIMITED_TRUE
        link = links[n]
        if not link.mass:
            if all(not other.mass for other in links[n:]) and not file.dof_armature[dof]:
                raise _error(source, f"limbs.{limb}.joints", "links that have a mass", f"none at {name!r}", name)
            link = _Link(_PAD[0], origin, _PAD[1] * np.eye(3))
        _weigh(body, link._replace(center=axes.T @ (link.center - origin), inertia=axes.T @ link.inertia @ axes))
        _draw(body, axes.T @ (end - origin), first=n == 0, last=n == len(chain) - 1)
        parent_axes, parent_origin = axes, origin
    at_foot = parent_axes.T @ (foot - parent_origin)
    for n in range(len(chain), len(names)):
        body = body.add_body(name=f"{limb}_{names[n]}", pos=at_foot)
        limits = dict(range=[-np.pi, np.pi], limited=mujoco.mjtLimited.mjLIMITED_TRUE)
        body.add_joint(
            name=f"{limb}_{names[n]}",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=[0, 0, 1],
            armature=1.0,
            group=FILLING,
            **limits,
        )
        _weigh(body, _Link(_PAD[0], np.zeros(3), _PAD[1] * np.eye(3)))
        at_foot = np.zeros(3)
    body.add_site(name=f"{limb}_foot", pos=at_foot, size=[0.004] * 3)


def _frame(axis: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Return a rotation matrix with z along `axis`, and x as near to a direction as that allows."""
    across = towards - axis * (axis @ towards)
    if np.linalg.norm(across) < 1e-6:
        across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    x = across / np.linalg.norm(across)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def compiled_robot(source: RobotFile, spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Return the model of what `spec_of` or `unposed` describe.

    Raises:
        RobotError: masses or inertias that no body can have.
    """
    try:
        return spec.compile()
    except ValueError as error:
        raise _error(source, "file", "masses and inertias that a body can have", str(error).splitlines()[0]) from None


def _stand(source: RobotFile, spec: mujoco.MjSpec, offset: np.ndarray) -> None:
    """Give the model its rest stance as a keyframe."""
    model = compiled_robot(source, spec)
    limbs = _around(source)
    feet = np.array([[*limb.foothold, -source.height] for limb in limbs.values()]) - offset
    joints = limb_joints(model, feet)
    for limb, error in zip(limbs, joints.errors, strict=True):
        if error > 1e-9:
            expected = f"a foothold within reach and joint limits at a height of {source.height:g} m"
            got = f"one that the foot misses by {error * 1e3:.3g} mm" if np.isfinite(error) else "one beyond the limits"
            raise _error(source, f"limbs.{limb}.foothold", expected, got)
    height = source.height + offset[2]
    position = [offset[0], offset[1], height]
    spec.add_key(name="stance", qpos=[*position, 1, 0, 0, 0, *joints.angles.ravel()])
    spec.body("base").pos = position


# ------------------------------------------------------------------------------------------------------------
# What is drawn: the shapes of the robots that come with mjx_climb


def _scene() -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    for name, color in (
        ("ground", [0.60, 0.56, 0.51, 1]),
        ("shell", [0.86, 0.87, 0.88, 1]),
        ("servo", [0.16, 0.17, 0.19, 1]),
        ("frame", [0.95, 0.55, 0.15, 1]),
        ("gripper", [0.30, 0.33, 0.37, 1]),
    ):
        spec.add_material(name=name, rgba=color)
    spec.worldbody.add_light(pos=[0.3, -0.6, 1.5], dir=[-0.2, 0.4, -1])
    ground = spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.1])
    ground.material, ground.contype, ground.conaffinity = "ground", 0, 0
    return spec


def _shape(body: mujoco.MjsBody, kind: mujoco.mjtGeom, material: str, **where: list[float]) -> None:
    body.add_geom(type=kind, material=material, contype=0, conaffinity=0, mass=0, group=1, **where)


def _base_anchor(data: mujoco.MjData, chain: list[int], axes: np.ndarray, base: _Link) -> np.ndarray:
    return np.asarray(axes.T @ (data.xanchor[chain[0]] - base.center))


def _box(body: mujoco.MjsBody, hips: np.ndarray) -> None:
    half = np.abs(hips).max(0).clip(0.01)
    _shape(body, mujoco.mjtGeom.mjGEOM_BOX, "shell", size=[0.95 * half[0], 0.95 * half[1], 0.2 * half[:2].min()])


def _draw(body: mujoco.MjsBody, end: np.ndarray, *, first: bool, last: bool) -> None:
    thick = float(np.clip(0.12 * np.linalg.norm(end), 0.003, 0.014))
    _shape(body, mujoco.mjtGeom.mjGEOM_CYLINDER, "servo", size=[1.2 * thick, 1.4 * thick, 0])
    if np.linalg.norm(end) < _SHORT:
        return
    stop = 0.85 * end if last else end
    material = "frame" if first or last else "shell"
    _shape(body, mujoco.mjtGeom.mjGEOM_CAPSULE, material, size=[0.7 * thick, 0, 0], fromto=[0, 0, 0, *stop])
    if last:
        _shape(body, mujoco.mjtGeom.mjGEOM_CAPSULE, "gripper", size=[thick, 0, 0], fromto=[*stop, *end])
