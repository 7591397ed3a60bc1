"""What a robot's file suggests for a scenario: base, limbs, feet, stance, a gait in proportion, what was left out."""

import collections
import itertools
import os
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot.description import JOINTS, RobotError, bare, line_of
from mjx_climb.robot.posture import limb_joints
from mjx_climb.robot.robot_file import unposed
from mjx_climb.scenario.model import MAX_LIMBS, MIN_LIMBS, RobotFile

MOST_JOINTS, FEWEST_JOINTS = 7, 2  # of a limb
_FOOT = re.compile(
    r"foot|feet|toe|grip|hand|palm|wheel|claw|magnet|hoof|(?<![a-z])(ee|end|tip|tool|tcp)(?![a-z])", re.IGNORECASE
)
# HubRobo v3.2, in proportion to which a gait and a grip are proposed
_MASS, _REACH = 2.2539, 0.287  # kg, m
_STRIDE, _STEP_HEIGHT = 0.05, 0.03  # m
_CONTACT = {"stiffness": 1.0e4, "damping": 20.0, "holding_limit": 15.0}
_CONTROL = {"damping": 5.0e3, "stiffness": 5.0e4}
_LOOP = {"kp": 50.0, "kd": 0.2}
_SHARES = (0.35, 0.5, 0.65, 0.2, 0.05, 0.8)  # of a limb's reach: how far out and how far down a foot may stand

_WELL = 0.15  # of a joint's range to its limits: a stance that will do


class Note(NamedTuple):
    """What became of something in the file."""

    kind: str  # taken, changed or ignored
    what: str
    why: str


class Proposal(NamedTuple):
    """Sections of a scenario, and how they came about."""

    sections: dict[str, Any]
    notes: tuple[Note, ...]


class _Chain(NamedTuple):
    """A row of joints from the base outwards that may be a limb."""

    joints: tuple[int, ...]
    foot: str
    at: tuple[float, float, float]  # m, in the frame of `foot`
    named: bool  # what it ends in is called a foot, or the like


def propose(file: str | os.PathLike[str]) -> Proposal:
    """Return sections of a scenario for the robot in an MJCF or URDF; what remains is to choose a time step.

    Raises:
        RobotError: a file that MuJoCo does not load, or one without a base and two limbs of two joints or more.
    """
    path = os.path.abspath(os.fspath(file))
    notes: list[Note] = []
    model = _loaded(path)
    described = mujoco.MjSpec.from_file(path)
    base = _base(path, model)
    notes.append(Note("taken", f"base {model.body(base).name!r}", "the link that floats, or that all limbs meet in"))
    chains = [_footed(described, model, chain) for chain in _chains(model, base)]
    driven = _driven(described)
    chains = [_without_passive(model, chain, driven, notes) for chain in chains]
    limbs = _named(model, _limbs(path, model, chains, notes))
    held = _held(model, limbs, notes)
    _looks(described, model, path, notes)

    key = _keyframe(model)
    hips = _stretched(model, base, limbs)
    section = _section(path, model, limbs, held)
    standing = _of_keyframe(model, base, limbs, key) if key is not None else None
    stance = _checked(section, standing) if standing is not None else None
    if stance is not None:
        notes.append(Note("taken", f"stance of keyframe {model.key(key).name!r}", "the feet stand where it puts them"))
    else:
        stance = _searched(path, section, hips)
        notes.append(Note("changed", "stance", "searched: feet below and around their hips, joints off their limits"))
    section["height"] = round(stance.height, 4)
    for name, foothold in zip(limbs, stance.footholds, strict=True):
        section["limbs"][name]["foothold"] = [round(float(v), 4) for v in foothold]

    reach = float(np.mean([hip.reach for hip in hips]))
    mass = float(model.body_subtreemass[base])
    gait = _gait(section, limbs, reach, notes)
    sections = {"robot": section, "gait": gait, "duration": 2 * gait["cycle"], **_proportions(mass, reach)}
    notes.append(Note("changed", "contact and control", f"HubRobo's in proportion to {mass:.3g} kg and {reach:.3g} m"))
    servo = _servo(described, model, limbs, notes)
    if servo:
        sections["hardware"] = {"servo": servo}
    return Proposal(sections, tuple(notes))


# ------------------------------------------------------------------------------------------------------------
# The file


def _loaded(path: str) -> mujoco.MjModel:
    try:
        return bare(path).compile()
    except (ValueError, OSError, mujoco.FatalError) as error:
        reason = " ".join((str(error) or "an empty one").split())
        raise RobotError(f"{path}: expected an MJCF or URDF that MuJoCo loads, got {reason[:300]}") from None


def _base(path: str, model: mujoco.MjModel) -> int:
    """Return the floating body, or the first one from the root outwards that several rows of joints start at."""
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    if len(free):
        return int(model.jnt_bodyid[free[0]])
    if model.nbody < 2:
        raise RobotError(f"{path}: expected a robot, got a file without bodies")
    part = _rigid(model)
    for body in range(1, model.nbody):
        if part[body] == body and len({a for a in _beyond(model, part, body)}) >= MIN_LIMBS:
            return body
    return 1


def _rigid(model: mujoco.MjModel) -> np.ndarray:
    """Return for each body the first body of the rigid part that it belongs to."""
    part = np.arange(model.nbody)
    for body in range(2, model.nbody):
        if not model.body_jntnum[body] and model.body_parentid[body] != 0:
            part[body] = part[model.body_parentid[body]]
    return part


def _beyond(model: mujoco.MjModel, part: np.ndarray, body: int) -> list[int]:
    """Return the jointed bodies that hang on a rigid part."""
    return [b for b in range(1, model.nbody) if model.body_jntnum[b] and part[model.body_parentid[b]] == body != b]


def _chains(model: mujoco.MjModel, base: int) -> list[list[int]]:
    """Return rows of bodies from the base outwards, at each fork along the longest branch."""
    part = _rigid(model)

    def longest(body: int) -> list[int]:
        return [body, *max((longest(b) for b in _beyond(model, part, body)), key=len, default=[])]

    return [longest(body) for body in _beyond(model, part, part[base])]


def _footed(described: mujoco.MjSpec, model: mujoco.MjModel, bodies: list[int]) -> _Chain:
    """Return a row of joints with its foot: a site or body called so, or else the far end of its last link."""
    joints = [int(model.body_jntadr[b]) + n for b in bodies for n in range(model.body_jntnum[b])]
    part = _rigid(model)
    data = _at_zero(model)
    last = [b for b in range(model.nbody) if part[b] == bodies[-1]]
    anchor = data.xanchor[joints[-1]]
    sites = [s for s in range(model.nsite) if model.site_bodyid[s] in last and model.site(s).name]
    places = [(model.site(s).name, data.site_xpos[s]) for s in sites]
    places += [(model.body(b).name, data.xpos[b]) for b in last if b != bodies[-1] and model.body(b).name]
    called = [place for place in places if _FOOT.search(place[0])]
    if called or places:
        name, _ = max(called or places, key=lambda place: float(np.linalg.norm(place[1] - anchor)))
        return _Chain(tuple(joints), name, (0.0, 0.0, 0.0), bool(called))
    body = described.body(model.body(bodies[-1]).name)
    ends = [end for geom in body.geoms for end in _ends(geom)]
    local = data.xmat[bodies[-1]].reshape(3, 3).T @ (anchor - data.xpos[bodies[-1]])
    end = max(ends, key=lambda point: float(np.linalg.norm(point - local)), default=2 * model.body_ipos[bodies[-1]])
    at = tuple(round(float(v), 5) for v in end)
    return _Chain(tuple(joints), model.body(bodies[-1]).name, (at[0], at[1], at[2]), bool(ends))


def _ends(geom: mujoco.MjsGeom) -> list[np.ndarray]:
    """Return the points of a plain shape that may be the tip of a limb, in its body's frame."""
    if np.isfinite(geom.fromto).all():
        return [np.array(geom.fromto[:3]), np.array(geom.fromto[3:])]
    if geom.type == mujoco.mjtGeom.mjGEOM_SPHERE:
        return [np.array(geom.pos)]
    if geom.type in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER):
        axis = np.empty(3)
        mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, geom.size[1]]), np.array(geom.quat))
        return [geom.pos - axis, geom.pos + axis]
    return []


def _at_zero(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[np.isin(model.jnt_type, JOINTS)]] = 0
    mujoco.mj_kinematics(model, data)
    return data


def _driven(described: mujoco.MjSpec) -> set[str]:
    """Return the joints that an actuator drives; none where the file has no actuators."""
    return {actuator.target for actuator in described.actuators if actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT}


def _without_passive(model: mujoco.MjModel, chain: _Chain, driven: set[str], notes: list[Note]) -> _Chain:
    """Return a row without the joints at its end that nothing drives, where something drives the others."""
    joints = list(chain.joints)
    if not any(model.joint(j).name in driven for j in joints):
        return chain
    while model.joint(joints[-1]).name not in driven:
        notes.append(Note("changed", f"joint {model.joint(joints[-1]).name!r}", "nothing drives it: held at its value"))
        joints.pop()
    return chain._replace(joints=tuple(joints))


def _limbs(path: str, model: mujoco.MjModel, chains: list[_Chain], notes: list[Note]) -> list[_Chain]:
    """Return the rows that are limbs: those that end in feet, or else those of the commonest number of joints."""
    for number, chain in enumerate(chains):
        if len(chain.joints) > MOST_JOINTS:
            notes.append(
                Note("changed", f"{len(chain.joints)} joints in a row", f"the last beyond {MOST_JOINTS} are held")
            )
            chains[number] = chain._replace(joints=chain.joints[:MOST_JOINTS])
    able = [chain for chain in chains if len(chain.joints) >= FEWEST_JOINTS]
    feet = [chain for chain in able if chain.named]
    found = feet if len(feet) >= MIN_LIMBS else able
    counts = collections.Counter(len(chain.joints) for chain in found)
    if len(counts) > 1 and (common := counts.most_common(1)[0])[1] >= 3:
        found = [chain for chain in found if len(chain.joints) == common[0]]
    if len(found) < MIN_LIMBS:
        expected = f"{MIN_LIMBS} limbs or more, rows of {FEWEST_JOINTS} joints or more from the base"
        raise RobotError(f"{path}: expected {expected}, got {len(found)}")
    if len(found) > MAX_LIMBS:
        notes.append(Note("ignored", f"{len(found) - MAX_LIMBS} limbs", f"more than {MAX_LIMBS}: held"))
    several = [j for chain in found for j in chain.joints if model.body_jntnum[model.jnt_bodyid[j]] > 1]
    if several:
        name = model.joint(several[0]).name
        raise RobotError(f"{line_of(path, name)}: expected one joint for each body, got several at that of {name!r}")
    if nameless := [j for chain in found for j in chain.joints if not model.joint(j).name]:
        body = model.body(model.jnt_bodyid[nameless[0]]).name
        raise RobotError(f"{line_of(path, body)}: expected joints with names, got none at body {body!r}")
    return found[:MAX_LIMBS]


def _named(model: mujoco.MjModel, limbs: list[_Chain]) -> dict[str, _Chain]:
    """Return the limbs by what the names of their joints have in common, at the beginning or at the end."""

    def words(chain: _Chain) -> list[list[str]]:
        return [[w for w in re.split(r"[_\-. /]+", model.joint(j).name) if w] for j in chain.joints]

    def common(rows: list[list[str]]) -> list[str]:
        shared = []
        for column in zip(*rows, strict=False):
            if len(set(column)) > 1:
                break
            shared.append(column[0])
        return shared

    beginnings = ["_".join(common(words(chain))) for chain in limbs]
    ends = ["_".join(common([row[::-1] for row in words(chain)])[::-1]) for chain in limbs]
    bodies = [model.body(model.jnt_bodyid[chain.joints[0]]).name for chain in limbs]
    for names in (beginnings, ends, bodies):
        if all(names) and len(set(names)) == len(names) and not any("." in name for name in names):
            return dict(zip(names, limbs, strict=True))
    return {f"limb{n + 1}": chain for n, chain in enumerate(limbs)}


def _held(model: mujoco.MjModel, limbs: dict[str, _Chain], notes: list[Note]) -> dict[str, float]:
    """Return the joints of no limb and where they are held: at the keyframe's value, or as near to zero as they go."""
    ours = {joint for chain in limbs.values() for joint in chain.joints}
    key, held = _keyframe(model), {}
    for joint in range(model.njnt):
        if joint in ours or int(model.jnt_type[joint]) not in JOINTS:
            continue
        value = 0.0 if key is None else float(model.key_qpos[key][model.jnt_qposadr[joint]])
        if model.jnt_limited[joint]:
            value = float(np.clip(value, *model.jnt_range[joint]))
        held[model.joint(joint).name] = round(value, 6)
        notes.append(Note("changed", f"joint {model.joint(joint).name!r}", f"of no limb: held at {value:.3g}"))
    return held


def _looks(described: mujoco.MjSpec, model: mujoco.MjModel, path: str, notes: list[Note]) -> None:
    """Note what the file holds and the dynamics do not need."""
    if meshes := len(described.meshes) - model.nmesh:
        notes.append(Note("ignored", f"{meshes} meshes", "looks: masses and inertias are written down"))
    for parts, what in ((described.sensors, "sensors"), (described.equalities, "equality constraints")):
        if len(parts):
            notes.append(Note("ignored", f"{len(parts)} {what}", "not simulated"))
    if len(described.actuators):
        notes.append(
            Note("changed", f"{len(described.actuators)} actuators", "the joint loop's torques take their place")
        )
    unmended = bare(path)
    unmended.compiler.balanceinertia = False
    try:
        unmended.compile()
    except ValueError as error:
        reason = " ".join(str(error).split())
        notes.append(Note("changed", "inertias that no body can have", f"their moments are made equal ({reason[:80]})"))


# ------------------------------------------------------------------------------------------------------------
# Stance


class _Hip(NamedTuple):
    place: np.ndarray  # (3,) m, base link's frame, of the first joint
    reach: float  # m, length of all links


class _Stance(NamedTuple):
    height: float  # m
    footholds: np.ndarray  # (L, 2) m


def _keyframe(model: mujoco.MjModel) -> int | None:
    """Return the keyframe that a robot stands in: by its name, or the first."""
    names = [model.key(k).name for k in range(model.nkey)]
    return next((names.index(n) for n in ("stance", "stand", "home") if n in names), 0 if names else None)


def _in_base(data: mujoco.MjData, base: int, point: np.ndarray) -> np.ndarray:
    return np.asarray(data.xmat[base].reshape(3, 3).T @ (point - data.xpos[base]))


def _foot(model: mujoco.MjModel, data: mujoco.MjData, chain: _Chain) -> np.ndarray:
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, chain.foot)
    if site >= 0:
        return np.array(data.site_xpos[site])
    body = model.body(chain.foot).id
    return np.asarray(data.xpos[body] + data.xmat[body].reshape(3, 3) @ np.array(chain.at))


def _stretched(model: mujoco.MjModel, base: int, limbs: dict[str, _Chain]) -> list[_Hip]:
    data = _at_zero(model)
    hips = []
    for chain in limbs.values():
        points = [*(data.xanchor[j] for j in chain.joints), _foot(model, data, chain)]
        reach = sum(np.linalg.norm(b - a) for a, b in itertools.pairwise(points))
        hips.append(_Hip(_in_base(data, base, points[0]), float(reach)))
    return hips


def _of_keyframe(model: mujoco.MjModel, base: int, limbs: dict[str, _Chain], key: int) -> _Stance | None:
    data = mujoco.MjData(model)
    data.qpos[:] = model.key_qpos[key]
    mujoco.mj_kinematics(model, data)
    feet = np.array([_in_base(data, base, _foot(model, data, chain)) for chain in limbs.values()])
    height = -float(feet[:, 2].mean())
    return _Stance(height, feet[:, :2]) if height > 0 else None


def _section(path: str, model: mujoco.MjModel, limbs: dict[str, _Chain], held: dict[str, float]) -> dict[str, Any]:
    named = {}
    for name, chain in limbs.items():
        named[name] = {"joints": [model.joint(j).name for j in chain.joints], "foot": chain.foot}
        if any(chain.at):
            named[name]["at"] = list(chain.at)
    section: dict[str, Any] = {"file": path, "height": 1.0, "limbs": named}
    return section | ({"locked": held} if held else {})


def _source(section: dict[str, Any], footholds: np.ndarray) -> RobotFile:
    limbs = {
        name: limb | {"foothold": [float(v) for v in foothold]}
        for (name, limb), foothold in zip(section["limbs"].items(), footholds, strict=True)
    }
    return RobotFile.model_validate(section | {"limbs": limbs})


def _judge(section: dict[str, Any], footholds: np.ndarray) -> Callable[[_Stance], float]:
    """Return what tells of a stance how far its joints are off their limits, as a share of the range; below 0: unmet.

    `footholds` (L, 2) m are somewhere about where the feet are to stand.
    """
    source = _source(section, footholds)
    spec, offset = unposed(source)
    try:
        model = spec.compile()
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise RobotError(f"{source.file}: expected masses and inertias that bodies can have, got {reason}") from None
    order = [model.site(s).name.removesuffix("_foot") for s in range(model.nsite)]
    rows = [list(section["limbs"]).index(name) for name in order]
    lower, upper = model.jnt_range[1:].reshape(len(rows), -1, 2).transpose(2, 0, 1)

    def margin(stance: _Stance) -> float:
        feet = np.column_stack([stance.footholds, np.full(len(rows), -stance.height)])[rows] - offset
        found = limb_joints(model, feet)
        share = np.minimum(found.angles - lower, upper - found.angles) / (upper - lower)
        return float(share.min()) if found.errors.max() < 1e-9 else -1.0

    return margin


def _checked(section: dict[str, Any], stance: _Stance) -> _Stance | None:
    rounded = _Stance(round(stance.height, 4), stance.footholds.round(4))
    return rounded if _judge(section, rounded.footholds)(rounded) > 0 else None


def _searched(path: str, section: dict[str, Any], hips: list[_Hip]) -> _Stance:
    """Return a stance, the feet some way out and down, whose joints are well off their limits, or the best there is."""
    reach = min(hip.reach for hip in hips)
    places = np.array([hip.place for hip in hips])
    away = places[:, :2] / np.maximum(np.linalg.norm(places[:, :2], axis=1, keepdims=True), 1e-6)
    stances = []
    for out in _SHARES:
        for down in _SHARES:
            height = round(down * reach - float(places[:, 2].min()), 4)
            if np.hypot(out, down) < 1 and height > 0:
                stances.append(_Stance(height, (places[:, :2] + out * reach * away).round(4)))
    margin = _judge(section, stances[0].footholds)
    best, most = None, 0.0
    for stance in stances:
        if (found := margin(stance)) > most:
            best, most = stance, found
        if most > _WELL:
            break
    if best is None:
        raise RobotError(f"{path}: expected a stance with all feet in reach, found none")
    return best


# ------------------------------------------------------------------------------------------------------------
# Gait, grip and drives


def _gait(section: dict[str, Any], limbs: dict[str, _Chain], reach: float, notes: list[Note]) -> dict[str, Any]:
    """Return a crawl: up one side from behind, then up the other, strides and steps that all limbs can reach."""
    footholds = np.array([section["limbs"][name]["foothold"] for name in limbs])
    height = section["height"]
    order = sorted(range(len(limbs)), key=lambda n: (footholds[n, 1] < 0, footholds[n, 0]))
    stride, step = _STRIDE * reach / _REACH, _STEP_HEIGHT * reach / _REACH
    margin = _judge(section, footholds)
    for _ in range(5):
        moves = [np.array([x, 0.0]) for x in (-stride, stride)]
        stances = [_Stance(height, footholds + move) for move in moves] + [_Stance(height - step, footholds)]
        if all(margin(stance) > 0 for stance in stances):
            break
        stride, step = stride / 2, step / 2
    share = 1 - 1 / len(limbs)
    duty = max(0.75, -(-share * 100 // 1) / 100)
    names = list(limbs)
    notes.append(Note("changed", "gait", f"a crawl in proportion to limbs of {reach:.3g} m"))
    return {
        "cycle": float(len(limbs)),
        "duty": duty,
        "stride": float(f"{stride:.2g}"),
        "step_height": float(f"{step:.2g}"),
        "sequence": [names[n] for n in order],
    }


def _proportions(mass: float, reach: float) -> dict[str, Any]:
    """Return grip and gains of HubRobo for another weight and length."""
    heavier = mass / _MASS
    turning = heavier * reach / _REACH

    def two_digits(value: float) -> float:
        return float(f"{value:.2g}")

    return {
        "gravity": [0.0, 0.0, -1.62],
        "contact": {name: two_digits(value * heavier) for name, value in _CONTACT.items()},
        "control": {name: two_digits(value * heavier) for name, value in _CONTROL.items()}
        | {name: two_digits(value * turning) for name, value in _LOOP.items()},
    }


def _servo(
    described: mujoco.MjSpec, model: mujoco.MjModel, limbs: dict[str, _Chain], notes: list[Note]
) -> dict[str, float]:
    """Return what the file says of the drives beside what stays with its joints."""
    joints = [joint for chain in limbs.values() for joint in chain.joints]
    dofs = model.jnt_dofadr[joints]
    for values, what in (
        (model.dof_armature, "armature"), (model.dof_damping, "damping"), (model.dof_frictionloss, "dry friction")
    ):  # fmt: skip
        if values[dofs].any():
            notes.append(
                Note("taken", f"{what} of the joints", f"{values[dofs].min():.3g} to {values[dofs].max():.3g}")
            )
    limits = [float(model.jnt_actfrcrange[j, 1]) for j in joints if model.jnt_actfrclimited[j]]
    names = {model.joint(j).name for j in joints}
    for actuator in described.actuators:
        if actuator.target in names and actuator.forcerange[1] > 0:
            limits.append(float(actuator.forcerange[1]))
    limits = [limit for limit in limits if limit > 0]
    if not limits:
        return {}
    notes.append(Note("taken", "torque limits", f"{min(limits):g} to {max(limits):g} N m; the smallest holds for all"))
    return {"torque_limit": min(limits)}
