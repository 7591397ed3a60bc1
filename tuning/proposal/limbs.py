"""The limbs of a robot in its file: rows of joints from one base outwards, each ending in a foot."""

import collections
import os
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot.constants import RobotError
from mjx_climb.robot_import.bodies import at_zero, beginning, robot_in
from mjx_climb.robot_import.description import TURNED, bare, compiled, described
from mjx_climb.scenario.model import MAX_LIMBS, MIN_LIMBS
from tuning.proposal.tree import FEWEST_JOINTS, UPRIGHT, Tree, fixed_joints

MOST_JOINTS = 7  # of a limb
# largest difference in joints from the number that three limbs or more of the robot have
_ALIKE = 2
# points at this share of the largest distance from the joint are part of a link's end
_AS_FAR = 0.98
# a body fixed to the last link is taken for its end from this share of the end that weights suggest
_NEAR_END = 0.75
_TILT = 0.2  # of the limbs' length, heights that are level all the same
_SHORT = 1e-3  # m, shortest last link with an end of its own
_FOOT = re.compile(
    r"foot|feet|toe|grip|hand|palm|wheel|claw|magnet|hoof|paw|suction|sucker|hook|spike|effector|tarsus|contact"
    r"|(?<![a-z])(ee|eef|end|tip|tool|tcp|pad|sole|cup|pincer|anchor)(?![a-z])"
)


class Note(NamedTuple):
    """The fate of a part of the file."""

    kind: str  # taken as it is, changed (or not in the file), or ignored
    what: str
    why: str


class Chain(NamedTuple):
    """A row of joints from the base outwards that may be a limb."""

    joints: tuple[int, ...]
    foot: str
    at: tuple[float, float, float]  # m, in the frame of `foot`
    named: bool  # it ends in a foot by name
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
        tree = Tree(self.model)
        if base is None and (base := tree.middle()):
            self.model = robot_in(self.path, base)
            why = "the middle of the one row of joints, from foot to foot; --base takes another"
        elif base is None and (base := tree.below_dummies()):
            self.model = robot_in(self.path, base)
            why = "the link that all limbs meet in; those from the file's root to it weigh nothing"
        self.tree = Tree(self.model) if base else tree
        hub = self.model.body(base).id if base else tree.hub()
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
        """Note the fate of a part of the file."""
        self.notes.append(Note(kind, what, why))

    def _limbs(self, hub: int) -> list[Chain]:
        """Return the rows that end in feet, of about the commonest number of joints."""
        model = self.model
        sites = {int(model.site_bodyid[site]) for site in range(model.nsite) if _is_foot(model.site(site).name)}
        # a link that moves by itself may be one of several in a foot
        fixed = {
            body for body in range(model.nbody) if self.tree.part[body] != body and _is_foot(model.body(body).name)
        }
        rows = self.tree.rows(hub, sites | fixed)
        names = {model.body(b).name for row in rows for b in self.tree.bodies[row[-1]]}
        try:
            shaped = compiled(self.path, bare(self.path, names))
        except RobotError as error:  # a mesh that cannot be read
            shaped = model
            self.note("ignored", "meshes of the last links", str(error))
        chains = [_footed(self.tree, row, shaped) for row in rows]
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
        anchors, _ = self._anchors(limbs)
        heights = anchors[..., 2]
        above = heights - heights.min(0)
        length = np.linalg.norm(anchors[:, 1] - anchors[:, 0], axis=1).mean()
        quarter = max(heights[:, 0].max() - heights[:, 1].min(), _TILT * length) / 4
        low, high = (
            [name for name, is_so in zip(limbs, so.all(1), strict=True) if is_so]
            for so in (above < quarter, above > quarter)
        )
        if len(low) >= MIN_LIMBS and high:
            if advice := self.other_up(limbs):
                raise RobotError(f"{self.path}: {advice}")
            got = f"{', '.join(high)} above {', '.join(low)}"
            choose = f"choose with --limbs {','.join(low)}, or --limbs {','.join(limbs)}"
            raise RobotError(f"{self.path}: expected limbs that stand on the ground, got {got}: {choose}")

    def _anchors(self, limbs: dict[str, Chain]) -> tuple[np.ndarray, np.ndarray]:
        """Return the first and the last joints of limbs (limb, 2, 3) m, and axes of the first, in the base's axes.

        They are as the file's first keyframe has them, or else with the joints at zero.
        """
        data = at_zero(self.model, self.tree.fixed)
        if self.model.nkey:
            data.qpos[:] = self.model.key_qpos[0]
            mujoco.mj_kinematics(self.model, data)
        ends = [[chain.joints[0], chain.joints[-1]] for chain in limbs.values()]
        axes = data.xmat[self.base].reshape(3, 3)
        return data.xanchor[ends] @ axes, data.xaxis[[first for first, _ in ends]] @ axes

    def other_up(self, limbs: dict[str, Chain]) -> str | None:
        """Return in words that another axis of the base than z seems to be up; None where none does.

        All limbs hang along it, or all begin with a joint that turns about it.
        """
        anchors, axes = self._anchors(limbs)
        ways = anchors[:, 1] - anchors[:, 0]
        hang = ways.mean(0) / max(float(np.linalg.norm(ways, axis=1).mean()), 1e-9)
        along = int(np.abs(hang).argmax())
        if abs(hang[along]) > UPRIGHT:
            got = f"limbs that hang along its {'+' if hang[along] > 0 else '-'}{'xyz'[along]}"
            upright = along == 2 and hang[2] < 0
        else:
            common = np.abs(axes).min(0)
            along = int(common.argmax())
            got, upright = f"limbs that all yaw about its {'xyz'[along]}", along == 2 or common[along] < UPRIGHT
        if upright:
            return None
        name = self.model.body(self.base).name
        mend = f"fix {name!r} to a link without a mass that has z up, and choose that with --base"
        return f"expected a base link whose z axis is up, got {name!r} with {got}: {mend}"


def _named(model: mujoco.MjModel, limbs: list[Chain]) -> dict[str, Chain]:
    """Return the limbs by the common part of their joints' names, at the beginning or at the end."""
    names = [[model.joint(joint).name for joint in chain.joints] for chain in limbs]
    words = [[[word for word in re.split(r"[_\-. /]+", name) if word] for name in row] for row in names]
    beginnings = ["_".join(beginning(rows)) for rows in words]
    ends = ["_".join(beginning([row[::-1] for row in rows])[::-1]) for rows in words]
    bodies = [model.body(model.jnt_bodyid[chain.joints[0]]).name for chain in limbs]
    for found in (beginnings, ends, bodies):
        if all(found) and len(set(found)) == len(found) and "." not in "".join(found):
            return dict(zip(found, limbs, strict=True))
    return {f"limb{n + 1}": chain for n, chain in enumerate(limbs)}


def _is_foot(name: str) -> bool:
    """Return whether a name is a foot's, also in the middle of one such as LegTip2."""
    return _FOOT.search(re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()) is not None


def _footed(tree: Tree, row: list[int], shaped: mujoco.MjModel) -> Chain:
    """Return a row of joints with its foot: a site or body called so, or else the far end of its last link.

    `shaped` is the robot with the shapes of the last links.
    """
    model, last = tree.model, tree.bodies[row[-1]]
    joints = [joint for body in row for joint in tree.joints[body]]
    data = at_zero(model, tree.fixed)
    anchor, place, axes = data.xanchor[joints[-1]], data.xpos[row[-1]], data.xmat[row[-1]].reshape(3, 3)

    def away(named: tuple[str, np.ndarray]) -> float:
        return float(np.linalg.norm(named[1] - anchor))

    sites = [s for s in range(model.nsite) if model.site_bodyid[s] in last]
    places = [(model.site(s).name, data.site_xpos[s]) for s in sites if model.site(s).name]
    places += [(model.body(b).name, data.xpos[b]) for b in last if b != row[-1]]
    called = [each for each in places if _is_foot(each[0])]
    end, what = _far_end(shaped, {model.body(b).name for b in last}, anchor)
    if called:
        return Chain(tuple(joints), max(called, key=away)[0], (0.0, 0.0, 0.0), True)
    local = 2 * model.body_ipos[row[-1]] if end is None else axes.T @ (end - place)
    own = axes.T @ (anchor - place)
    turns = model.jnt_type[joints[-1]] == mujoco.mjtJoint.mjJNT_HINGE
    if end is None and turns and np.linalg.norm(local - own) < _SHORT:
        # as long as the link before, and square to the joint's axis: along it no joint would move the foot
        axis, link = data.xaxis[joints[-1]], anchor - data.xanchor[joints[-2 if joints[1:] else -1]]
        across = link - axis * (axis @ link)
        local = own + axes.T @ across * (np.linalg.norm(link) / (np.linalg.norm(across) or 1.0))
    if end is None and places:  # something small may be fixed anywhere on the link
        farthest = max(places, key=away)
        if away(farthest) > _NEAR_END * np.linalg.norm(local - own):
            return Chain(tuple(joints), farthest[0], (0.0, 0.0, 0.0), False, "", True)
    x, y, z = (round(float(v), 5) + 0.0 for v in local)  # no -0.0
    named = bool(what) and " mesh " not in what  # many a head ends in a mesh
    return Chain(tuple(joints), model.body(row[-1]).name, (x, y, z), named, what, end is None)


def _far_end(model: mujoco.MjModel, bodies: set[str], anchor: np.ndarray) -> tuple[np.ndarray | None, str]:
    """Return where the shapes of some bodies end, seen from `anchor` (3,) m, and the shapes that end there; or None.

    Of shapes that collide, or else of those that are looked at; the middle of the points about as far as the farthest,
    as the tips of fingers, or the rim of a wheel.
    """
    data = at_zero(model, fixed_joints(model))
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


def driven_joints(described: mujoco.MjSpec) -> set[str]:
    """Return the joints that an actuator drives, itself or by a tendon; none where the file has no actuators."""
    joints = set()
    for actuator in described.actuators:
        if actuator.trntype in TURNED:
            joints.add(actuator.target)
        elif actuator.trntype == mujoco.mjtTrn.mjTRN_TENDON and (tendon := described.tendon(actuator.target)):
            joints |= {wrap.target.name for wrap in tendon.path if wrap.type == mujoco.mjtWrap.mjWRAP_JOINT}
    return joints
