"""Random robots from MJCF files against MuJoCo's own compile of the file: masses, feet, drives and limits."""

import math

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mjx_climb.robot.constants import frame_along
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.model import RobotFile

SLIDE = mujoco.mjtJoint.mjJNT_SLIDE


class Writer:
    """A robot written joint by joint, and the values that its joints should have, by their names."""

    def __init__(self, seed):
        self.draw = np.random.default_rng(seed)
        self.limbs, self.locked, self.springs, self.expected, self.drives = {}, {}, {}, {}, []

    def row(self, size, scale):
        return " ".join(f"{each:.6f}" for each in self.draw.uniform(-scale, scale, size))

    def turn(self):
        """Text of an attitude, in one of the ways that a file may give it, or of none."""
        axis, angle = self.row(3, 1.0), self.draw.uniform(-3, 3)
        return self.draw.choice(
            ["", f'euler="{self.row(3, 1.5)}"', f'axisangle="{axis} {angle}"', f'quat="{self.row(4, 1)}"']
        )

    def inertia(self, mass):
        root = self.draw.uniform(0.01, 0.05, 3)
        moments = mass * np.array([root[1:] @ root[1:], root[::2] @ root[::2], root[:2] @ root[:2]])
        axes = Rotation.random(random_state=int(self.draw.integers(1000))).as_matrix()
        full = axes @ np.diag(moments) @ axes.T
        place = f'<inertial pos="{self.row(3, 0.03)}" mass="{mass}" '
        if self.draw.random() < 0.5:
            return place + f'diaginertia="{" ".join(map(repr, moments.tolist()))}" {self.turn()}/>'
        six = " ".join(repr(full[n].item()) for n in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
        return f'{place}fullinertia="{six}"/>'

    def beside(self, name):
        """A body that is fixed, one on a joint that is held, or none."""
        kind = self.draw.choice(["none", "fixed", "light", "held"])
        if kind == "none":
            return ""
        joint, mass = "", 0.0 if kind == "light" else self.draw.uniform(0.02, 0.1)
        if kind == "held":
            joint = f'<joint name="{name}_held" type="{self.draw.choice(["hinge", "slide"])}" axis="{self.row(3, 1)}"/>'
            self.locked[f"{name}_held"] = float(self.draw.uniform(-0.4, 0.4))
        weight = self.inertia(mass) if mass else ""
        return f'<body name="{name}_beside" pos="{self.row(3, 0.05)}" {self.turn()}>{joint}{weight}</body>'

    def joint(self, name):
        """Text of a joint; its values are noted."""
        draw, slides = self.draw, self.draw.random() < 0.2
        given, text, most = {}, "", 1.0 if slides else math.pi
        for key, field, size in (
            ("armature", "armature", 0.01), ("damping", "damping", 0.2), ("frictionloss", "friction", 0.3),
            ("stiffness", "spring", 2.0), ("springref", "spring_rest", 0.3),
        ):  # fmt: skip
            given[field] = 0.0
            if draw.random() < 0.6:
                given[field] = round(draw.uniform(0.1, 1) * size, 5)
                text += f'{key}="{given[field]}" '
        limits = draw.choice(["none", "some", "off", "a turn", "more below"])
        given["joint_lower"], given["joint_upper"] = -most, most
        lower, upper = {
            "a turn": (-math.pi, 3.5), "more below": (-4.0, 1.0)
        }.get(limits, (-draw.uniform(0.1, 0.9), draw.uniform(0.1, 0.9)))  # fmt: skip
        if limits != "none":
            text += f'range="{lower} {upper}" ' + 'limited="false" ' * (limits == "off")
        if limits == "some" or limits == "more below" or (slides and limits == "a turn"):
            given["joint_lower"], given["joint_upper"] = lower, upper
        given["torque_limit"] = np.inf
        if draw.random() < 0.4:
            given["torque_limit"] = 3.5
            text += 'actuatorfrcrange="-3.5 4" '
        for _ in range(draw.integers(0, 3)):
            kind, gear = draw.choice(["motor", "forces", "position", "free"]), round(draw.uniform(-3, 3), 3)
            low, high = -round(draw.uniform(0.2, 1), 3), round(draw.uniform(0.2, 1), 3)
            if kind == "forces" and draw.random() < 0.3:
                low = 0.1 * high  # it pushes one way alone
            ranges = {"motor": "ctrlrange", "forces": "forcerange"}.get(kind)
            limited = f'{ranges}="{low} {high}"' if ranges else 'ctrlrange="-1 1"' * (kind == "position")
            tag = "position" if kind == "position" else "motor"
            self.drives.append((name, f'<{tag} joint="{name}" gear="{gear}" {limited}/>'))
            ends = sorted((gear * low, gear * high))
            one = min(-ends[0], ends[1]) if ends[0] < 0 < ends[1] else max(-ends[0], ends[1])
            given.setdefault("by actuators", []).append(one if ranges else np.inf)
        by_actuators = sum(given.pop("by actuators", [np.inf]))
        given["torque_limit"] = given["torque_limit"] if np.isfinite(given["torque_limit"]) else by_actuators
        given["slides"] = slides
        self.expected[name] = given
        where = f'pos="{self.row(3, 0.02)}" axis="{self.row(3, 1)}"'
        return f'<joint name="{name}" type="{"slide" if slides else "hinge"}" {where} {text}/>'

    def spring(self, name):
        """A spring in place of a drive."""
        own, given = self.expected[name], {"stiffness": 2.5, "damping": 0.04, "rest": -0.2}
        self.springs[name] = given
        own.update(spring=2.5, damping=own["damping"] + 0.04, spring_rest=-0.2, passive=True)

    def limb(self, name, count):
        """Text of the bodies of a limb, from the base outwards."""
        joints = [f"{name}_j{n}" for n in range(count)]
        self.limbs[name] = {"joints": joints, "foot": f"{name}_foot", "at": self.draw.uniform(-0.02, 0.02, 3).tolist()}
        text, n, depth = "", 0, 0
        while n < count:
            both = n + 1 < count and self.draw.random() < 0.2  # two joints of one body
            own = joints[n : n + 1 + both]
            text += f'<body name="{own[-1]}" pos="{self.row(3, 0.1)}" {self.turn()}>' + "".join(map(self.joint, own))
            text += self.inertia(self.draw.uniform(0.05, 0.3)) + self.beside(own[-1])
            n, depth = n + len(own), depth + 1
        if count > 1 and self.draw.random() < 0.5:
            self.spring(joints[int(self.draw.integers(count))])
        return text + f'<site name="{name}_foot" pos="{self.row(3, 0.1)}" {self.turn()}/>' + "</body>" * depth

    def inwards(self, name, count):
        """Text of a limb from its last link to the base, and of the bodies' ends: the file begins at its foot."""
        joints = [f"{name}_j{n}" for n in range(count)]
        self.limbs[name] = {"joints": joints, "foot": f"{name}_foot", "at": [0.01, 0.0, -0.02]}
        site = f'<site name="{name}_foot" pos="{self.row(3, 0.1)}" {self.turn()}/>'
        text = f'<body name="{name}_end" {self.turn()}>{site}' + self.inertia(0.2) + self.beside(f"{name}_end")
        for joint in joints[:0:-1]:
            text += f'<body name="{joint}" pos="{self.row(3, 0.1)}" {self.turn()}>' + self.joint(joint)
            text += self.inertia(0.1) + self.beside(joint)
        return text, self.joint(joints[0]), "</body>" * count

    def robot(self, root):
        count = int(self.draw.integers(1, 5))
        before, between, after = self.inwards("L0", int(self.draw.integers(1, 5))) if root == "a foot" else ("", "", "")
        trunk = f'<body name="trunk" pos="{self.row(3, 0.1)}" {self.turn()}>{between}' + self.inertia(1.0)
        trunk += self.beside("trunk")
        trunk += "".join(self.limb(f"L{n}", int(self.draw.integers(1, 6))) for n in range(bool(before), count))
        body = f"{before}{trunk}</body>{after}"
        drives = "".join(text for _, text in self.drives)
        head = '<mujoco><compiler autolimits="true" angle="radian" eulerseq="xyz"/><worldbody>'
        return f"{head}{body}</worldbody><actuator>{drives}</actuator></mujoco>"


def theirs_of(text, root, locked):
    """Return the model of the file, set free and without its drives, and the numbers of the degrees that move."""
    spec = mujoco.MjSpec.from_string(text)
    spec.body(root).add_freejoint(name="free")
    model = spec.compile()
    held = {model.joint(name).dofadr[0] for name in locked}
    return model, [n for n in range(model.nv) if n not in held]


@pytest.mark.parametrize("seed", range(16))
def test_a_random_robot_is_the_one_that_mujoco_reads(saved, seed):
    writer, root = Writer(seed), "a foot" if seed % 3 == 2 else "trunk"
    text = writer.robot(root)
    file = saved(text, "random.xml")
    sections = {"file": str(file), "limbs": writer.limbs, "locked": writer.locked, "springs": writer.springs}
    robot = load_robot(RobotFile.model_validate(sections | ({"base": "trunk"} if root == "a foot" else {})))
    places = robot.places_in_file()
    assert list(places) == [joint for limb in writer.limbs.values() for joint in limb["joints"]]

    fields = ("armature", "damping", "friction", "spring", "spring_rest", "joint_lower", "joint_upper", "torque_limit")
    for name, place in places.items():
        for field in fields:
            values, own = getattr(robot, field), writer.expected[name][field]
            if field == "spring_rest" and writer.expected[name]["spring"] == 0:
                continue  # of no spring
            got = values[place] if values is not None else np.inf if field == "torque_limit" else 0.0
            assert got == pytest.approx(own, abs=1e-9), (name, field)
        assert writer.expected[name]["slides"] == (robot.sliding is not None and robot.sliding[place]), name
        driven = robot.driven is None or robot.driven[place]
        assert driven != writer.expected[name].get("passive", False), name

    model, moving = theirs_of(text, "L0_end" if root == "a foot" else "trunk", writer.locked)
    theirs, ours = mujoco.MjData(model), mujoco.MjData(robot.model)
    trunk, part = model.body("trunk").id, base_bodies(model, writer.locked)
    for _ in range(3):
        for name, place in places.items():
            angle = writer.draw.uniform(-1, 1)
            theirs.joint(name).qpos[:] = angle
            ours.joint(f"{robot.limbs[place[0]]}_{robot.joint_names[place[1]]}").qpos[:] = angle
        for name, value in writer.locked.items():
            theirs.joint(name).qpos[:] = value
        mujoco.mj_forward(model, theirs)
        axes = theirs.xmat[trunk].reshape(3, 3)
        center = model.body_mass[part] @ theirs.xipos[part] / model.body_mass[part].sum()
        ours.qpos[:3] = center
        mujoco.mju_mat2Quat(ours.qpos[3:7], axes.ravel())
        mujoco.mj_forward(robot.model, ours)
        # velocities of ours by theirs: of the base's centre and about its own axes, and of the joints
        moved = np.zeros((robot.model.nv, model.nv))
        place_rates, turns = np.zeros((2, 3, model.nv))
        mujoco.mj_jac(model, theirs, place_rates, turns, center, trunk)
        moved[:3], moved[3:6] = place_rates, axes.T @ turns
        for name, place in places.items():
            own = robot.model.joint(f"{robot.limbs[place[0]]}_{robot.joint_names[place[1]]}").dofadr[0]
            moved[own, model.joint(name).dofadr[0]] = 1.0
        mass, other = np.zeros((robot.model.nv,) * 2), np.zeros((model.nv,) * 2)
        mujoco.mj_fullM(robot.model, ours, mass)
        mujoco.mj_fullM(model, theirs, other)
        found = (moved.T @ mass @ moved)[np.ix_(moving, moving)]
        expected = other[np.ix_(moving, moving)]
        np.testing.assert_allclose(found, expected, atol=3e-6 * np.abs(expected).max())
        for limb, name in enumerate(robot.limbs):
            site = theirs.site(f"{name}_foot")
            foot = site.xpos + site.xmat.reshape(3, 3) @ writer.limbs[name]["at"]
            np.testing.assert_allclose(ours.site_xpos[limb], foot, atol=1e-7)


def base_bodies(model, locked):
    """The bodies that move with the trunk: it, and those fixed to it."""
    held = {model.joint(name).id for name in locked}
    found = {model.body("trunk").id}
    for body in range(1, model.nbody):
        own = {n for n in range(model.njnt) if model.jnt_bodyid[n] == body}
        if own <= held and model.body_parentid[body] in found:
            found.add(body)
    return sorted(found)


@pytest.mark.parametrize("tilt", [1.2, 1e-3, 2e-6, 5e-7, 0.0])
def test_a_frame_has_its_x_as_near_to_a_direction_as_its_axis_allows(tilt):
    """Along the axis there is none: x is then square to the coordinate axis that is squarest to it."""
    for axis, side in Rotation.random(9, random_state=0).as_matrix()[:, :2]:
        found = frame_along(axis, math.cos(tilt) * axis + math.sin(tilt) * side)
        np.testing.assert_allclose(found[:, 2], axis)
        np.testing.assert_allclose(found.T @ found, np.eye(3), atol=1e-9)
        assert np.linalg.det(found) > 0
        if tilt > 1e-6:
            np.testing.assert_allclose(found[:, 0], side, atol=1e-9)
        else:
            assert found[np.abs(axis).argmin(), 0] == pytest.approx(0, abs=1e-9)
