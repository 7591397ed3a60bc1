"""The tree of a robot: its rigid parts, the hub of its limbs, and rows of joints from there outwards."""

from collections.abc import Collection

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot_import.bodies import at_zero, joints_of, rigid_parts
from mjx_climb.robot_import.description import SPECK
from mjx_climb.scenario.model import MIN_LIMBS

FEWEST_JOINTS = 2  # of a limb
UPRIGHT = 0.7  # least cosine between two axes that both are up
# beyond `_ARM` joints, branches of `_FINGER` joints or fewer are the fingers of a hand
_ARM, _FINGER = 3, 3
# ranges of joints that move no foot to speak of, as a force sensor's may be written; rad or m
_HARDLY = {int(mujoco.mjtJoint.mjJNT_HINGE): 0.01, int(mujoco.mjtJoint.mjJNT_SLIDE): 0.003}


def fixed_joints(model: mujoco.MjModel) -> dict[int, float]:
    """Return the joints whose limits leave them hardly any range, and the middles of these, rad or m."""
    return {
        joint: float(np.mean(limits))
        for joint, limits in enumerate(model.jnt_range)
        if model.jnt_limited[joint] and np.ptp(limits) <= _HARDLY.get(int(model.jnt_type[joint]), -1.0)
    }


class Tree:
    """The rigid parts of a robot, each called by its first body, and the bodies beyond each; see `fixed_joints`."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, self.fixed = model, fixed_joints(model)
        self.part = rigid_parts(model, set(self.fixed))
        self.joints = [[j for j in joints_of(model, body) if j not in self.fixed] for body in range(model.nbody)]
        self.beyond: list[list[int]] = [[] for _ in range(model.nbody)]  # jointed bodies that hang on each part
        self.bodies: list[list[int]] = [[] for _ in range(model.nbody)]  # of each part
        for body in range(model.nbody):
            self.bodies[self.part[body]].append(body)
            if body and self.joints[body]:
                self.beyond[self.part[model.body_parentid[body]]].append(body)

    def hub(self) -> int:
        """Return the body that limbs begin at: the floating one, or the first one from the root outwards."""
        model = self.model
        rows = {body: len(self.beyond[body]) for body in range(1, model.nbody) if self.part[body] == body}
        free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        floating = [int(model.jnt_bodyid[joint]) for joint in free]
        if floating and rows[most := max(floating, key=lambda body: rows[body])] >= MIN_LIMBS:
            return most
        hubs = [body for body, count in rows.items() if count >= MIN_LIMBS]
        return next((body for body in hubs if model.body_rootid[body] in floating), hubs[0] if hubs else 1)

    def middle(self) -> str | None:
        """Return the body in the middle of a robot that is one row of joints, from foot to foot; None of any other."""
        rows = self.rows(1)
        joints = [body for body in rows[0] for _ in self.joints[body]] if len(rows) == 1 else []
        floats = (self.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any()
        if floats or len(joints) < 2 * FEWEST_JOINTS or any(len(self.beyond[body]) > 1 for body in joints):
            return None
        return str(self.model.body(joints[len(joints) // 2 - 1]).name)

    def below_dummies(self) -> str | None:
        """Return the body that all limbs hang on, where the bodies above it, with the root, weigh nothing; else None.

        Many a URDF has such a root, `base_footprint`, on the floor (ROS REP 120). A file with keyframes keeps its root,
        which these place, and so does one whose root alone has a z axis that is up.
        """
        model, hub = self.model, self.hub()
        rows = []  # of bodies, from the hub to each limb's parent
        for body in model.body_parentid[self.beyond[hub]].tolist():
            row = [body]
            while row[0] not in (0, hub):
                row.insert(0, int(model.body_parentid[row[0]]))
            rows.append(row)
        shared = [bodies[0] for bodies in zip(*rows, strict=False) if len(set(bodies)) == 1]
        if model.nkey or len(shared) < 2 or model.body_rootid[hub] != hub:
            return None
        up = at_zero(model, self.fixed).xmat[[hub, shared[-1]], 6:]
        if (model.body_mass[shared[:-1]] > SPECK).any() or up[0] @ up[1] < UPRIGHT:
            return None
        return str(model.body(shared[-1]).name)

    def rows(self, base: int, feet: Collection[int] = ()) -> list[list[int]]:
        """Return rows of bodies from the base outwards, at each fork along the longest branch, as far as to fingers.

        Those are of a hand with several, or beyond a part with one of the bodies `feet`, unless another is farther out.
        """

        def count(row: list[int]) -> int:
            return sum(len(self.joints[body]) for body in row)

        outwards, inner = list(self.beyond[self.part[base]]), np.zeros(self.model.nbody, int)
        for body in outwards:
            inner[body] += len(self.joints[body])
            inner[self.beyond[body]] = inner[body]
            outwards += self.beyond[body]
        longest: dict[int, list[int]] = {}
        ends = {body for body in outwards if not {*feet}.isdisjoint(self.bodies[body])}
        for body in reversed(outwards):
            branches = [longest[branch] for branch in self.beyond[body]]
            hand = len(branches) > 1 or (body in ends and not any(ends & {*branch} for branch in branches))
            fingers = hand and inner[body] >= _ARM and all(count(branch) <= _FINGER for branch in branches)
            longest[body] = [body] if fingers else [body, *max(branches, key=count, default=[])]
        return [longest[body] for body in self.beyond[self.part[base]]]
