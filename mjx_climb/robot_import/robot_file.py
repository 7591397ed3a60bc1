"""A user's own robot: from her MJCF or URDF and the joints and feet that she names, to the model simulated here."""

import itertools
import re
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot.constants import FILLING, PASSIVE, Robot, RobotError, frame_along, robot_from_model
from mjx_climb.robot_import.bodies import add_joint, at_zero, beginning, foot_of, quaternion, rigid_parts, robot_in
from mjx_climb.robot_import.description import COLUMNS, JOINTS, ROWS, SPECK
from mjx_climb.robot_import.markup import is_urdf, line_of
from mjx_climb.scenario.model import RobotFile

SNAP = 1e-4  # rad: axes as near as this to parallel or square are meant so; many a URDF has pi / 2 as 1.5708
REACH = 1.0  # m, of a sliding joint without limits, either way
_SHORT = 1e-3  # m, links too short to draw
_LIMITED = mujoco.mjtLimited.mjLIMITED_TRUE
_COLORS = {  # red, green, blue, opacity
    "ground": [0.60, 0.56, 0.51, 1],
    "shell": [0.68, 0.70, 0.72, 1],  # lighter, all shading would be lost in the sun
    "servo": [0.16, 0.17, 0.19, 1],
    "frame": [0.95, 0.55, 0.15, 1],
    "gripper": [0.30, 0.33, 0.37, 1],
}


def refusal(source: RobotFile, key: str, expected: str, got: str, element: str | None = None) -> RobotError:
    """Return an error of one line, which begins with the place of an element in the file."""
    place = source.file if element is None else line_of(source.file, element)
    return RobotError(" ".join(f"{place}: robot.{key}: expected {expected}, got {got}".split()))


def unposed(source: RobotFile) -> tuple[mujoco.MjSpec, Robot, np.ndarray]:
    """Return a robot as simulated before it stands, and its base's centre of mass in its link's frame, (3,) m.

    The base frame has the axes of the file's base link and sits at the base's centre of mass. Only masses, joints with
    the armature, damping and dry friction of their drives, and feet are taken over; the bodies are drawn as plain
    shapes. Limbs come counter-clockwise, seen from above, by where their feet stand. One of fewer joints than others is
    filled up with joints at its foot that move nothing.

    Raises:
        RobotError: in one line, the key of the config, the expected and the found.
    """
    file = _File(source)
    axes, center = file.data.xmat[file.base].reshape(3, 3), file.trunk.center
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    for material, color in _COLORS.items():
        spec.add_material(name=material, rgba=color)
    spec.worldbody.add_light(pos=[0.3, -0.6, 1.5], dir=[-0.2, 0.4, -1])
    ground = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "material": "ground", "size": [2, 2, 0.1]}
    spec.worldbody.add_geom(name="ground", contype=0, conaffinity=0, **ground)
    body = spec.worldbody.add_body(name="base")
    body.add_freejoint(name="base")
    _weigh(body, file.trunk, center, axes)
    hips = file.data.xanchor[[chain[0] for chain in file.chains.values()]] - center
    half = np.abs(hips @ axes).max(0).clip(0.01)
    _shape(body, mujoco.mjtGeom.mjGEOM_BOX, "shell", size=[0.95 * half[0], 0.95 * half[1], 0.2 * half[:2].min()])
    names = _joint_names([limb.joints for limb in file.limbs.values()])
    ahead = {"size": [0.06 * half[0], 0.6 * half[1], 0.22 * half[:2].min()], "pos": [0.7 * half[0], 0, 0]}
    _shape(body, mujoco.mjtGeom.mjGEOM_BOX, "frame", **ahead)
    for limb in file.limbs:
        _add_limb(file, limb, names, body)
    try:
        model = spec.compile()
    except ValueError as error:
        got = str(error).splitlines()[0]
        raise refusal(source, "file", "masses and inertias that a body can have", got) from None
    # it rests with its springs slack
    return spec, robot_from_model(model, "robot", model.qpos_spring), axes.T @ (center - file.data.xpos[file.base])


class RootLink(NamedTuple):
    """The link of a robot's file that all others hang on: viewers place the whole robot by it."""

    name: str
    links: tuple[str, ...]  # names of all links
    pose: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]  # of joint angles (limb, joint), see `root_link`


def root_link(source: RobotFile, robot: Robot) -> RootLink:
    """Return the root link of a robot's file, whose `pose` gives its place (3,) m and rotation (3, 3).

    Both are seen from the simulated base frame, at the base's centre of mass. They change with the angles where
    `robot.base` has chosen another link of the file to be the base.
    """
    file, model = _File(source), robot_in(source.file)
    offset = file.data.xmat[file.base].reshape(3, 3).T @ (file.trunk.center - file.data.xpos[file.base])
    base = model.body(file.model.body(file.base).name).id
    root, data = int(model.body_rootid[base]), at_zero(model)
    for name, value in source.locked.items():
        data.joint(name).qpos[:] = value
    places = robot.places_in_file()

    def pose(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        for name, place in places.items():
            data.joint(name).qpos[:] = angles[place]
        mujoco.mj_kinematics(model, data)
        axes = data.xmat[base].reshape(3, 3)
        return axes.T @ (data.xpos[root] - data.xpos[base]) - offset, axes.T @ data.xmat[root].reshape(3, 3)

    return RootLink(model.body(root).name, tuple(model.body(body).name for body in range(1, model.nbody)), pose)


class _Link(NamedTuple):
    """A rigid part: its bodies are those between one joint and the next."""

    mass: float  # kg
    center: np.ndarray  # (3,) m
    inertia: np.ndarray  # (3, 3) kg m^2 about the centre


_HELD = _Link(1.0, np.zeros(3), 0.01 * np.eye(3))  # a base that is held, and that its file gives no mass
_PAD = _Link(1e-9, np.zeros(3), 1e-12 * np.eye(3))  # of a joint that only fills up a limb, at its foot


class _File:
    """The joints, links and feet that a scenario's section names in a robot's file, with the joints at zero."""

    def __init__(self, source: RobotFile) -> None:
        self.source, self.model = source, robot_in(source.file, source.base)
        sought = "a revolute or prismatic joint of the file", "none of that name"
        self.held = {self._joint(name, f"locked.{name}", *sought): value for name, value in source.locked.items()}
        self.data, self.part = at_zero(self.model, self.held), rigid_parts(self.model, set(self.held))
        self.springs = dict(source.springs.items())
        self.limbs = source.in_order
        known = ", ".join(self.model.joint(i).name for i in range(self.model.njnt)) or "none"
        expected = f"revolute or prismatic joints of the file ({known[:200]})"
        self.chains = {
            name: [self._joint(joint, f"limbs.{name}.joints", expected, repr(joint)) for joint in limb.joints]
            for name, limb in self.limbs.items()
        }
        self.base = self._inner(next(iter(self.chains.values()))[0])[1]
        self.trunk = self.link(self.base)
        if source.on_stand and not self.trunk.mass:
            self.trunk = _HELD._replace(center=self.trunk.center)
        for wrong in self._wrong():
            raise refusal(source, *wrong)

    def _joint(self, name: str, key: str, expected: str, got: str) -> int:
        joint = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_JOINT, name)
        if joint < 0 or self.model.jnt_type[joint] not in JOINTS:
            raise refusal(self.source, key, expected, got)
        return int(joint)

    def _inner(self, joint: int) -> tuple[int, int]:
        """Return the joint that a joint hangs on, -1 for none, and the body that it does."""
        model, body = self.model, int(self.model.jnt_bodyid[joint])
        parent = int(self.part[model.body_parentid[body]])
        moving = [j for j in range(model.njnt) if j not in self.held and int(model.jnt_type[j]) in JOINTS]
        if before := [j for j in moving if model.jnt_bodyid[j] == body and j < joint]:
            return before[-1], body
        return max((j for j in moving if model.jnt_bodyid[j] == parent), default=-1), parent

    def _wrong(self) -> Iterator[tuple[str, str, str, str]]:
        """Yield refusals: the key, the expected, the found, and the element in the file."""
        model, names = self.model, [self.model.joint(joint).name for joint in range(self.model.njnt)]
        base, ours = model.body(self.base).name, [joint for chain in self.chains.values() for joint in chain]
        for limb, chain in self.chains.items():
            for joint in self.held.keys() & chain:
                yield f"locked.{names[joint]}", "a joint of no limb", f"one of {limb}", names[joint]
            for inner, outer in itertools.pairwise(chain):
                if self._inner(outer)[0] != inner:
                    got = f"{names[outer]!r} not next after {names[inner]!r}"
                    yield f"limbs.{limb}.joints", "a chain from the base outwards", got, names[outer]
        begins = f"all limbs to begin at one base link, as {next(iter(self.chains))} does at {base!r}"
        for limb, chain in self.chains.items():
            inner, body = self._inner(chain[0])
            if body != self.base or (body == 0 and not self.source.on_stand) or inner >= 0:
                yield f"limbs.{limb}.joints", begins, repr(model.body(body).name), names[chain[0]]
        own = model.body_rootid == model.body_rootid[self.base]  # bodies of the robot
        for joint in ours:
            if ours.count(joint) > 1:
                yield "limbs", "different joints", f"{names[joint]!r} twice", names[joint]
        for joint in set(range(model.njnt)) - set(ours) - self.held.keys():
            floats = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE and model.jnt_bodyid[joint] == self.base
            if not floats and own[model.jnt_bodyid[joint]]:
                hold = f"robot.locked.{names[joint]}: 0 would hold it"
                expected = f"no joints but those named and the base's own ({hold})"
                yield "limbs", expected, repr(names[joint]), names[joint]
        for constraint in np.flatnonzero(model.eq_active0):
            if (name := self._bound(int(constraint), own)) is not None:
                kind = "mimic" if is_urdf(self.source.file) else "equality constraints"
                yield "file", f"no {kind} between moving parts", f"one at {name!r}", name
        for name in self.springs.keys() - {names[joint] for joint in ours}:
            yield f"springs.{name}", "a joint of a limb", "one of none", name
        for limb, keys in self.limbs.items():
            if self.springs.keys() >= set(keys.joints):
                yield f"limbs.{limb}.joints", "a joint that is driven", "springs in all", keys.joints[0]
        if not self.trunk.mass:
            yield "file", f"a mass of the base link {base!r}", "none", base

    def _bound(self, constraint: int, own: np.ndarray) -> str | None:
        """Return the name of an equality constraint that could move a part of the robot; None for one that cannot."""
        model, names = self.model, [self.model.equality(constraint).name]
        site, body = mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_BODY
        ends = [int(end[constraint]) for end in (model.eq_obj1id, model.eq_obj2id) if end[constraint] >= 0]
        idle = False
        if model.eq_type[constraint] == mujoco.mjtEq.mjEQ_JOINT:
            idle = all(end in self.held or not own[model.jnt_bodyid[end]] for end in ends)
            names.append(model.joint(ends[0]).name)
        elif (kind := mujoco.mjtObj(model.eq_objtype[constraint])) in (site, body):
            bodies = model.site_bodyid[ends] if kind == site else np.array(ends)
            idle = len(set(self.part[bodies])) == 1 or not own[bodies].any()
            names.append((model.site if kind == site else model.body)(ends[0]).name)
        return None if idle else next(filter(None, names), "")

    def link(self, first: int) -> _Link:
        """Return the bodies of a rigid part as one, those without a mass left out; world axes."""
        model, data = self.model, self.data
        bodies = np.flatnonzero((self.part == first) & (model.body_mass > SPECK))
        if not len(bodies):
            return _Link(0.0, data.xpos[first].copy(), np.zeros((3, 3)))
        masses = model.body_mass[bodies]
        center, inertia = masses @ data.xipos[bodies] / masses.sum(), np.zeros((3, 3))
        for body, mass in zip(bodies, masses, strict=True):
            axes, r = data.ximat[body].reshape(3, 3), data.xipos[body] - center
            inertia += axes @ np.diag(model.body_inertia[body]) @ axes.T + mass * (r @ r * np.eye(3) - np.outer(r, r))
        return _Link(float(masses.sum()), center, inertia)

    def foot(self, limb: str) -> np.ndarray:
        """Return the foot of a limb, (3,) m in world axes: a site or a body fixed to the last link."""
        model, (name, last) = self.model, (self.limbs[limb].foot, self.chains[limb][-1])
        if name is None:
            return self.link(int(model.jnt_bodyid[last])).center
        site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
        body = model.site_bodyid[site] if site >= 0 else mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        if body < 0:
            raise refusal(self.source, f"limbs.{limb}.foot", "a site, body or link of the file", repr(name))
        if self.part[body] != model.jnt_bodyid[last]:
            expected = f"a place on the link of joint {model.joint(last).name!r}"
            raise refusal(self.source, f"limbs.{limb}.foot", expected, f"{name!r}, which is not fixed to it")
        return foot_of(model, self.data, name, self.limbs[limb].at)

    def axes(self, limb: str) -> list[np.ndarray]:
        """Return the axes of a limb's joints; near a yaw and two pitches, exactly these, which have a closed form."""
        chain = self.chains[limb]
        axes = list(self.data.xaxis[chain])
        if len(axes) != 3 or (self.model.jnt_type[chain] != mujoco.mjtJoint.mjJNT_HINGE).any():
            return axes
        coxa, femur, tibia = axes
        if abs(coxa @ femur) > SNAP or np.linalg.norm(np.cross(femur, tibia)) > SNAP:
            return axes
        femur = femur - coxa * (coxa @ femur)
        femur = femur / np.linalg.norm(femur)
        return [coxa, femur, np.sign(femur @ tibia) * femur]


def _joint_names(limbs: Sequence[Sequence[str]]) -> list[str]:
    """Return names of the joints from the base outwards: the file's, without the part that differs between limbs.

    LF_hip_joint, LF_knee_joint, RF_hip_joint and RF_knee_joint are hip and knee. Where nothing is left, or names are
    alike, joint1, joint2 and so on.
    """

    def shared(names: list[list[str]]) -> tuple[list[str], list[str]]:
        """Return with which words all of the names begin, and with which they end."""
        head = beginning(names)
        return head, beginning([name[len(head) :][::-1] for name in names])[::-1]

    if len(limbs) == 1:
        # a body is called limb_joint
        names = [name.replace("_", " ") for name in limbs[0]]
        return names if len(set(names)) == len(names) else [f"joint{n + 1}" for n in range(len(names))]
    places = [[re.split(r"[\W_]+", name) for name in place if name] for place in itertools.zip_longest(*limbs)]
    words = [list(itertools.chain(*shared(place))) for place in places]
    head, tail = shared(words)
    names = [" ".join(place[len(head) : len(place) - len(tail)]) for place in words]
    told_apart = len(set(names)) == len(names) and all(re.search("[A-Za-z]", name) for name in names)
    return names if told_apart else [f"joint{n + 1}" for n in range(len(places))]


def _add_limb(file: _File, limb: str, names: Sequence[str], body: mujoco.MjsBody) -> None:
    """Add one limb to the base; the frame of each link sits at its joint, z along the axis, x towards the next."""
    origin, axes = file.trunk.center, file.data.xmat[file.base].reshape(3, 3)
    chain, foot = file.chains[limb], file.foot(limb)
    stands, anchors = [file.model.jnt_bodyid[joint] for joint in chain], [*file.data.xanchor[chain], foot]
    # of several joints of one body the last one moves its mass
    links = [file.link(at) if at not in stands[n + 1 :] else None for n, at in enumerate(stands)]
    for n, (joint, axis) in enumerate(zip(chain, file.axes(limb), strict=True)):
        place, inner = axes.T @ (anchors[n] - origin), axes
        origin, end = anchors[n : n + 2]
        axes = frame_along(axis, end - origin)
        body = body.add_body(name=f"{limb}_{names[n]}", pos=place, quat=quaternion(inner.T @ axes))
        dof, name = file.model.jnt_dofadr[joint], file.model.joint(joint).name
        moved = add_joint(body, file.model, joint, f"{limb}_{names[n]}")
        lower, upper = file.model.jnt_range[joint]
        most = REACH if moved.type == mujoco.mjtJoint.mjJNT_SLIDE else np.pi
        if not file.model.jnt_limited[joint] or (most == np.pi and lower <= -np.pi and upper >= np.pi):
            lower, upper = -most, most  # a turn or more is as free as no limits
        moved.axis, moved.range, moved.limited = [0, 0, 1], [lower, upper], _LIMITED
        if spring := file.springs.get(name):
            moved.damping = [moved.damping[0] + spring.damping, 0, 0]  # beside the file's
            moved.stiffness, moved.springref, moved.group = [spring.stiffness, 0, 0], spring.rest, PASSIVE
        if (link := links[n]) and link.mass:
            _weigh(body, link, origin, axes)
        elif any(link and link.mass for link in links[n:]) or file.model.dof_armature[dof]:
            _weigh(body, _PAD, np.zeros(3), np.eye(3))
        else:
            raise refusal(file.source, f"limbs.{limb}.joints", "links that have a mass", f"none at {name!r}", name)
        _draw(body, axes.T @ (end - origin), first=n == 0, last=n == len(chain) - 1)
    at_foot = axes.T @ (foot - origin)
    for name in names[len(chain) :]:
        body = body.add_body(name=f"{limb}_{name}", pos=at_foot)
        hinge = body.add_joint(name=f"{limb}_{name}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1], armature=1.0)
        hinge.range, hinge.limited, hinge.group = [-np.pi, np.pi], _LIMITED, FILLING
        _weigh(body, _PAD, np.zeros(3), np.eye(3))
        at_foot = np.zeros(3)
    body.add_site(name=f"{limb}_foot", pos=at_foot, size=[0.004] * 3)


def _weigh(body: mujoco.MjsBody, link: _Link, origin: np.ndarray, axes: np.ndarray) -> None:
    """Give a body the mass of a link, seen from the body's own frame, whose axes (3, 3) are columns."""
    body.explicitinertial, body.mass, body.ipos = True, link.mass, axes.T @ (link.center - origin)
    body.fullinertia = (axes.T @ link.inertia @ axes)[ROWS, COLUMNS]


def _shape(body: mujoco.MjsBody, kind: mujoco.mjtGeom, material: str, **where: list[float]) -> None:
    body.add_geom(type=kind, material=material, contype=0, conaffinity=0, mass=0, group=1, **where)


def _draw(body: mujoco.MjsBody, end: np.ndarray, *, first: bool, last: bool) -> None:
    """Draw a link as those of the robots that come with mjx_climb are."""
    thick = float(np.clip(0.12 * np.linalg.norm(end), 0.003, 0.014))
    _shape(body, mujoco.mjtGeom.mjGEOM_CYLINDER, "servo", size=[1.2 * thick, 1.4 * thick, 0])
    if np.linalg.norm(end) < _SHORT:
        return
    stop = 0.85 * end if last else end
    material = "frame" if first or last else "shell"
    _shape(body, mujoco.mjtGeom.mjGEOM_CAPSULE, material, size=[0.7 * thick, 0, 0], fromto=[0, 0, 0, *stop])
    if last:
        _shape(body, mujoco.mjtGeom.mjGEOM_CAPSULE, "gripper", size=[thick, 0, 0], fromto=[*stop, *end])
