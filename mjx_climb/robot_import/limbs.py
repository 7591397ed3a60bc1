"""The limbs of a robot in its file: rows of joints from one base outwards, each ending in a foot.

A file that begins at a foot is turned round first, so that it begins at the base.
"""

import collections
import itertools
import os
import re
from collections.abc import Mapping, Sequence, Set
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot.constants import RobotError
from mjx_climb.robot_import.description import JOINTS, SPECK, bare, compiled, described, driven_joints, one_limit
from mjx_climb.scenario.model import MAX_LIMBS, MIN_LIMBS, Limb

MOST_JOINTS, FEWEST_JOINTS = 7, 2  # of a limb
# beyond `_ARM` joints, branches of `_FINGER` joints or fewer are the fingers of a hand
_ARM, _FINGER = 3, 3
# largest difference in joints from the number that three limbs or more of the robot have
_ALIKE = 2
# points at this share of the largest distance from the joint are part of a link's end
_AS_FAR = 0.98
_SHORT = 1e-3  # m, shortest last link with an end of its own
_FOOT = re.compile(
    r"foot|feet|toe|grip|hand|palm|wheel|claw|magnet|hoof|(?<![a-z])(ee|end|tip|tool|tcp)(?![a-z])", re.IGNORECASE
)


class Note(NamedTuple):
    """What became of something in the file."""

    kind: str  # taken as it is, changed (or not in the file), or ignored
    what: str
    why: str


class Chain(NamedTuple):
    """A row of joints from the base outwards that may be a limb."""

    joints: tuple[int, ...]
    foot: str
    at: tuple[float, float, float]  # m, in the frame of `foot`
    named: bool  # what it ends in is called a foot, or the like
    end: str = ""  # shapes that the last link ends with, where nothing in the file is called its foot
    guessed: bool = False  # there are none


class Found:
    """The robot in a file, whose limbs begin at the body `base`, and which stands on those in `stand_on`.

    Where these are not given: on all limbs, which begin at the floating body, or the first one from the root outwards
    that they can begin at, or in the middle of a robot that is one row of joints.

    Raises:
        RobotError: a file that MuJoCo does not load, one without a base and two limbs, or no such base or limbs; none
            is chosen and some start and end so much higher than others, in the file's stance, as arms do above legs.
    """

    def __init__(self, file: str | os.PathLike[str], base: str | None = None, stand_on: Sequence[str] = ()) -> None:
        self.path, self.notes = os.path.abspath(os.fspath(file)), list[Note]()
        self.model, self.described = robot_in(self.path, base), described(self.path)  # masses and joints; all it holds
        if self.model.nbody < 2:
            raise RobotError(f"{self.path}: expected a robot, got a file without bodies")
        why = "as told" if base else "the link that floats, or that all limbs meet in"
        if base is None and (base := _middle_of(self.model)):
            self.model = robot_in(self.path, base)
            why = "the middle of the one row of joints, from foot to foot; --base takes another"
        elif base is None and (base := _below_dummies(self.model)):
            self.model = robot_in(self.path, base)
            why = "the link that all limbs meet in; those from the file's root to it weigh nothing"
        hub = self.model.body(base).id if base else _hub_of(self.model)
        self.root = base  # the body that was made the model's root; None: it is the file's
        self.base = int(self.model.body_rootid[hub])  # joints from there to the hub are of no limb
        self.note("taken", f"base {self.model.body(self.base).name!r}", why)
        every = _named(self.model, self._limbs(hub))
        if unknown := [name for name in stand_on if name not in every] or (len(stand_on) == 1 and list(stand_on)):
            expected = f"two or more of {', '.join(every)}"
            raise RobotError(f"{self.path}: --limbs: expected {expected}, got {', '.join(unknown)}")
        if not stand_on:
            self._check_level(every)
        self.limbs = {name: every[name] for name in every if not stand_on or name in stand_on}  # in the file's order
        self.joints = [joint for chain in self.limbs.values() for joint in chain.joints]

    def note(self, kind: str, what: str, why: str) -> None:
        """Note what became of something in the file."""
        self.notes.append(Note(kind, what, why))

    def _limbs(self, hub: int) -> list[Chain]:
        """Return the rows that end in feet, of about the commonest number of joints."""
        model = self.model
        rows, part = _rows(model, hub), rigid_parts(model)
        last = {body: [b for b in range(model.nbody) if part[b] == body] for body in (row[-1] for row in rows)}
        names = {model.body(b).name for bodies in last.values() for b in bodies}
        try:
            shaped = compiled(self.path, bare(self.path, names))
        except RobotError as error:  # a mesh that cannot be read
            shaped = model
            self.note("ignored", "meshes of the last links", str(error))
        chains = [_footed(model, row, last[row[-1]], shaped) for row in rows]
        if driven := driven_joints(self.described):
            chains = [chain for chain in chains if driven & {model.joint(j).name for j in chain.joints}]
        for number, chain in enumerate(chains):
            if len(chain.joints) > MOST_JOINTS:
                self.note("changed", f"{len(chain.joints)} joints in a row", f"the last beyond {MOST_JOINTS} are held")
                chains[number] = chain._replace(joints=chain.joints[:MOST_JOINTS])
        able = [chain for chain in chains if len(chain.joints) >= FEWEST_JOINTS]
        feet = [chain for chain in able if chain.named]
        limbs = feet if len(feet) >= MIN_LIMBS else able
        counts = collections.Counter(len(chain.joints) for chain in limbs)
        if len(counts) > 1 and (common := counts.most_common(1)[0])[1] >= 3:
            limbs = [chain for chain in limbs if abs(len(chain.joints) - common[0]) <= _ALIKE]
        if len(limbs) < MIN_LIMBS:
            expected = f"{MIN_LIMBS} limbs or more, rows of {FEWEST_JOINTS} joints or more from the base"
            raise RobotError(f"{self.path}: expected {expected}, got {len(limbs)}")
        if len(limbs) > MAX_LIMBS:
            self.note("ignored", f"{len(limbs) - MAX_LIMBS} limbs", f"more than {MAX_LIMBS}: held")
            limbs = limbs[:MAX_LIMBS]
        if guessed := [repr(chain.foot) for chain in limbs if chain.guessed]:
            why = f"not in the file ({', '.join(guessed)}), nor shapes: guessed from weights; correct robot.limbs' `at`"
            self.note("changed", "ends of last links", why)
        if ends := sorted({chain.end for chain in limbs if chain.end}):
            which = ", ".join(ends[:MAX_LIMBS]) + (", ..." if len(ends) > MAX_LIMBS else "")
            self.note("taken", "feet", f"where the shapes of the last links reach farthest: {which}")
        return limbs

    def _check_level(self, limbs: dict[str, Chain]) -> None:
        data = at_zero(self.model)
        if self.model.nkey:
            data.qpos[:] = self.model.key_qpos[0]
            mujoco.mj_kinematics(self.model, data)
        # of the first and the last joint of each limb, (limb, 2) m
        anchors = data.xanchor[[[chain.joints[0], chain.joints[-1]] for chain in limbs.values()]]
        heights = anchors @ data.xmat[self.base].reshape(3, 3)[:, 2]
        above = heights - heights.min(0)
        quarter = (heights[:, 0].max() - heights[:, 1].min()) / 4
        low, high = (
            [name for name, is_so in zip(limbs, so.all(1), strict=True) if is_so]
            for so in (above < quarter, above > quarter)
        )
        if len(low) >= MIN_LIMBS and high:
            got = f"{', '.join(high)} above {', '.join(low)}"
            choose = f"choose with --limbs {','.join(low)}, or --limbs {','.join(limbs)}"
            raise RobotError(f"{self.path}: expected limbs that stand on the ground, got {got}: {choose}")


def _hub_of(model: mujoco.MjModel) -> int:
    """Return the body that limbs begin at: the floating one, or the first one from the root outwards."""
    part = rigid_parts(model)
    rows = {body: len(_beyond(model, body)) for body in range(1, model.nbody) if part[body] == body}
    floating = [int(model.jnt_bodyid[joint]) for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)]
    if floating and rows[most := max(floating, key=lambda body: rows[body])] >= MIN_LIMBS:
        return most
    hubs = [body for body, count in rows.items() if count >= MIN_LIMBS]
    return next((body for body in hubs if model.body_rootid[body] in floating), hubs[0] if hubs else 1)


def _middle_of(model: mujoco.MjModel) -> str | None:
    """Return the body in the middle of a robot that is one row of joints, from foot to foot; None of any other."""
    rows = _rows(model, 1)
    joints = [body for body in rows[0] for _ in _joints(model, body)] if len(rows) == 1 else []
    floats = (model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any()
    if floats or len(joints) < 2 * FEWEST_JOINTS or any(len(_beyond(model, body)) > 1 for body in joints):
        return None
    return str(model.body(joints[len(joints) // 2 - 1]).name)


def _below_dummies(model: mujoco.MjModel) -> str | None:
    """Return the body that all limbs hang on, where it is not the root and what is above it weighs nothing; else None.

    Many a URDF has such a root, `base_footprint`, on the floor (ROS REP 120). A file with keyframes keeps its root,
    which these place.
    """
    hub = _hub_of(model)
    rows = []  # of bodies, from the hub to what each limb hangs on
    for body in model.body_parentid[_beyond(model, hub)].tolist():
        row = [body]
        while row[0] not in (0, hub):
            row.insert(0, int(model.body_parentid[row[0]]))
        rows.append(row)
    shared = [bodies[0] for bodies in zip(*rows, strict=False) if len(set(bodies)) == 1]
    if model.nkey or len(shared) < 2 or model.body_rootid[hub] != hub or (model.body_mass[shared[:-1]] > SPECK).any():
        return None
    return str(model.body(shared[-1]).name)


def rigid_parts(model: mujoco.MjModel, held: Set[int] = frozenset()) -> np.ndarray:
    """Return for each body the first body of the rigid part that it belongs to, where some joints are held."""
    part = np.arange(model.nbody)
    for body in range(1, model.nbody):
        parent = model.body_parentid[body]
        if parent != 0 and held >= set(_joints(model, body)):
            part[body] = part[parent]
    return part


def _joints(model: mujoco.MjModel, body: int) -> list[int]:
    return [int(joint) for joint in np.flatnonzero(model.jnt_bodyid == body)]


def _beyond(model: mujoco.MjModel, body: int) -> list[int]:
    """Return the jointed bodies that hang on the rigid part that begins with a body."""
    part = rigid_parts(model)
    return [b for b in range(1, model.nbody) if model.body_jntnum[b] and part[model.body_parentid[b]] == body != b]


def _rows(model: mujoco.MjModel, base: int) -> list[list[int]]:
    """Return rows of bodies from the base outwards, at each fork along the longest branch, as far as to fingers."""

    def count(row: list[int]) -> int:
        return int(model.body_jntnum[row].sum())

    def longest(body: int, before: int) -> list[int]:
        joints = before + int(model.body_jntnum[body])
        branches = [longest(b, joints) for b in _beyond(model, body)]
        fingers = len(branches) > 1 and joints >= _ARM and all(count(branch) <= _FINGER for branch in branches)
        return [body] if fingers else [body, *max(branches, key=count, default=[])]

    return [longest(body, 0) for body in _beyond(model, rigid_parts(model)[base])]


def beginning(names: Sequence[list[str]]) -> list[str]:
    """Return the words with which all names begin."""
    alike = itertools.takewhile(lambda words: len(set(words)) == 1, zip(*names, strict=False))
    return [words[0] for words in alike]


def _named(model: mujoco.MjModel, limbs: list[Chain]) -> dict[str, Chain]:
    """Return the limbs by what the names of their joints have in common, at the beginning or at the end."""
    names = [[model.joint(joint).name for joint in chain.joints] for chain in limbs]
    words = [[[word for word in re.split(r"[_\-. /]+", name) if word] for name in row] for row in names]
    beginnings = ["_".join(beginning(rows)) for rows in words]
    ends = ["_".join(beginning([row[::-1] for row in rows])[::-1]) for rows in words]
    bodies = [model.body(model.jnt_bodyid[chain.joints[0]]).name for chain in limbs]
    for found in (beginnings, ends, bodies):
        if all(found) and len(set(found)) == len(found) and "." not in "".join(found):
            return dict(zip(found, limbs, strict=True))
    return {f"limb{n + 1}": chain for n, chain in enumerate(limbs)}


def _footed(model: mujoco.MjModel, row: list[int], last: list[int], shaped: mujoco.MjModel) -> Chain:
    """Return a row of joints with its foot: a site or body called so, or else the far end of its last link.

    `last` are the bodies of the last link; `shaped` is the robot with the shapes of these.
    """
    joints = [joint for body in row for joint in _joints(model, body)]
    data = at_zero(model)
    anchor, place, axes = data.xanchor[joints[-1]], data.xpos[row[-1]], data.xmat[row[-1]].reshape(3, 3)
    sites = [s for s in range(model.nsite) if model.site_bodyid[s] in last]
    places = [(model.site(s).name, data.site_xpos[s]) for s in sites if model.site(s).name]
    places += [(model.body(b).name, data.xpos[b]) for b in last if b != row[-1]]
    called = [each for each in places if _FOOT.search(each[0])]
    end, what = _far_end(shaped, {model.body(b).name for b in last}, anchor)
    if called or (places and end is None):
        name, _ = max(called or places, key=lambda each: float(np.linalg.norm(each[1] - anchor)))
        return Chain(tuple(joints), name, (0.0, 0.0, 0.0), bool(called))
    local = 2 * model.body_ipos[row[-1]] if end is None else axes.T @ (end - place)
    own = axes.T @ (anchor - place)
    turns = model.jnt_type[joints[-1]] == mujoco.mjtJoint.mjJNT_HINGE
    if end is None and turns and np.linalg.norm(local - own) < _SHORT:
        # as long as the link before, and square to the joint's axis: along it no joint would move the foot
        axis, link = data.xaxis[joints[-1]], anchor - data.xanchor[joints[-2 if joints[1:] else -1]]
        across = link - axis * (axis @ link)
        local = own + axes.T @ across * (np.linalg.norm(link) / (np.linalg.norm(across) or 1.0))
    x, y, z = (round(float(v), 5) + 0.0 for v in local)  # no -0.0
    named = bool(what) and " mesh " not in what  # many a head ends in a mesh
    return Chain(tuple(joints), model.body(row[-1]).name, (x, y, z), named, what, end is None)


def _far_end(model: mujoco.MjModel, bodies: set[str], anchor: np.ndarray) -> tuple[np.ndarray | None, str]:
    """Return where the shapes of some bodies end, seen from `anchor` (3,) m, and the shapes that end there; or None.

    Of shapes that collide, or else of those that are looked at; the middle of what is about as far as the farthest, as
    are the tips of fingers, or the rim of a wheel.
    """
    data = at_zero(model)
    geoms = [geom for geom in range(model.ngeom) if model.body(model.geom_bodyid[geom]).name in bodies]
    colliding = [geom for geom in geoms if model.geom_contype[geom] or model.geom_conaffinity[geom]]
    kinds, points, owners = mujoco.mjtGeom, [np.empty((0, 3))], []
    for geom in colliding or geoms:
        size, local = model.geom_size[geom], np.empty((0, 3))
        match kinds(model.geom_type[geom]):
            case kinds.mjGEOM_SPHERE:
                local = np.zeros((1, 3))
            case kinds.mjGEOM_CAPSULE | kinds.mjGEOM_CYLINDER:
                local = np.array([[0, 0, -size[1]], [0, 0, size[1]]])
            case kinds.mjGEOM_BOX | kinds.mjGEOM_ELLIPSOID:
                local = np.vstack([-np.diag(size), np.diag(size)])
            case kinds.mjGEOM_MESH:
                mesh = model.mesh(model.geom_dataid[geom])
                local = model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
        points.append(data.geom_xpos[geom] + local @ data.geom_xmat[geom].reshape(3, 3).T)
        owners += [geom] * len(local)
    if not owners:
        return None, ""
    ends = np.concatenate(points)
    away = np.linalg.norm(ends - anchor, axis=1)
    # in words: "collision mesh 'tip' of 'calf'"
    geom = owners[int(np.argmax(away))]
    kind, body = kinds(model.geom_type[geom]), model.body(model.geom_bodyid[geom]).name
    name = f" {model.mesh(model.geom_dataid[geom]).name!r}" if kind == kinds.mjGEOM_MESH else ""
    shape = kind.name.removeprefix("mjGEOM_").lower()
    what = f"{'collision' if colliding else 'visual'} {shape}{name} of {body!r}"
    return ends[away >= _AS_FAR * away.max()].mean(0), what


def at_zero(model: mujoco.MjModel, held: Mapping[int, float] = MappingProxyType({})) -> mujoco.MjData:
    """Return the robot with its joints at zero, but for those that are held."""
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[np.isin(model.jnt_type, JOINTS)]] = 0
    data.qpos[model.jnt_qposadr[list(held)]] = list(held.values())
    mujoco.mj_kinematics(model, data)
    return data


def foot_of(model: mujoco.MjModel, data: mujoco.MjData, limb: Chain | Limb) -> np.ndarray:
    """Return where a limb's foot is, (3,) m in world axes; at a site as far off it as from a body."""
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, limb.foot)
    place = data.site(site) if site >= 0 else data.body(limb.foot)
    return np.asarray(place.xpos + place.xmat.reshape(3, 3) @ np.array(limb.at))


# ------------------------------------------------------------------------------------------------------------
# A file that begins at a foot


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
    opposite axis, so that its angle stays what it was. Joints between the old root and the world are left out.
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
