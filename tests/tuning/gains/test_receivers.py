"""Exported gains on a simulated receiver that does what the file says: it moves as the law does here.

The receiver knows the file alone: which input with which sign, along which axes, which axes count, the numbers. Its
integration is that of the program that the file is for.
"""

import csv
import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from scipy.linalg import expm

import mjx_climb as mc
from mjx_climb.control import Measurement, Reference, Start, law_of
from mjx_climb.physics.spatial import quaternion_from_rotation_vector, quaternion_to_matrix
from tuning.comparisons import deployment
from tuning.gains import gains_file

STEPS, PERIOD, LIMBS = 300, 1e-3, 4
SIX = ("x", "y", "z", "rx", "ry", "rz")
AXES = mc.Gains(*(np.array(values) for values in (
    [3.0, 2.0, 4.0, 0.3, 0.2, 0.5], [180.0, 90.0, 240.0, 9.0, 6.0, 15.0], [2e3, 5e3, 9e3, 90.0, 200.0, 50.0],
)))  # fmt: skip
SPLIT = mc.Gains(*(np.repeat(pair, 3) for pair in ([3.0, 0.3], [180.0, 9.0], [2e3, 90.0])))
LAWS = {
    "VirtualModelAdmittance": {"control.controller": "base_admittance"},
    "EndEffectorAdmittance": {"control.controller": "end_effector_admittance"},
    "MeasuredPoseAdmittance": {"control.controller": "base_admittance", "control.reading": "measured_pose"},
}


@pytest.fixture(scope="module")
def scene():
    """Measurements and references of a robot that stands askew: axes of the base reference are not the world's."""
    random, time = np.random.default_rng(3), PERIOD * np.arange(STEPS)[:, None, None]
    orientation = np.asarray(quaternion_from_rotation_vector(jnp.array([0.2, -0.3, 1.9])))
    base, size = np.array([0.3, -0.2, 0.1]), random.normal(0, 8, (LIMBS, 3))
    lever = random.normal(0, 0.2, (LIMBS, 3))
    force = size * np.sin(random.uniform(5, 60, (LIMBS, 3)) * time + random.uniform(0, 6, (LIMBS, 3)))
    wrench = np.concatenate([force.sum(1), np.cross(lever, force).sum(1)], axis=1)

    def still(value):
        return np.broadcast_to(value, (STEPS, *np.shape(value)))

    askew = quaternion_from_rotation_vector(jnp.array([0.21, -0.28, 1.9]))
    rates = random.normal(0, 0.1, (2, STEPS, 3))
    no_number, holds = np.zeros(STEPS), np.ones((STEPS, LIMBS), bool)
    measured = Measurement(
        still(base + np.array([0.004, 0.002, -0.003])), still(np.asarray(askew)), *rates, force, wrench, holds,
        *[no_number] * 3, holds[:, 0], no_number,
    )  # fmt: skip
    return measured, Reference(still(base), still(orientation), still(base + lever), *np.ones((2, STEPS, LIMBS)))


@pytest.fixture(scope="module")
def moved(scene):
    """What a law here does in the scene, by its scenario, each worked out once."""
    known = {}

    def of(scenario):
        if scenario not in known:
            known[scenario] = motion_of(scenario, scene)
        return known[scenario]

    return of


def motion_of(scenario, scene):
    """What the law here does: shift of the base (T, 6), and of the feet (T, limb, 3), along the reference's axes."""
    law, reference = law_of(scenario), scene[1]
    six = {name: jnp.broadcast_to(jnp.asarray(getattr(law, name)), field.shape) for name, field in law.GAINS.items()}
    law = type(law)(**vars(law) | six)
    start = Start(PERIOD, jax.tree.map(lambda values: jnp.asarray(values)[0], reference))

    def step(state, scene):
        return law.step(state, *scene)

    _, command = jax.lax.scan(step, law.init(start), jax.tree.map(jnp.asarray, scene))
    rotation = np.asarray(quaternion_to_matrix(jnp.asarray(reference.base_orientation[0])))
    return np.asarray(command.base_displacement), np.asarray(command.foot_position - reference.foot_position) @ rotation


def inputs(said, scene):
    """What the words of a file ask for, (T, instance, 6): six numbers of a sensor each, wanted by the law or not."""
    (sign, symbol), (measured, reference) = re.search(r"([+-])([wF]), [wF] the (?:sum|force) of", said).groups(), scene
    assert "in the axes of the base reference" in said
    rotation = np.asarray(quaternion_to_matrix(jnp.asarray(reference.base_orientation[0])))
    if symbol == "w":
        assert "about the base's centre of mass" in said
        given = measured.wrench.reshape(STEPS, 1, 2, 3)
    else:  # a sensor at a foot tells moments too
        assert "of the ground on the foot" in said and "One instance for each foot" in said
        given = np.stack([measured.foot_force, np.roll(measured.foot_force, 7, axis=0)], axis=2)
    return float(f"{sign}1") * (given @ rotation).reshape(STEPS, -1, 6)


def admittance_controller(text, scene):
    """The step of ros2_controllers' admittance_rule_impl.hpp, joints where they were sent."""
    (node,) = yaml.safe_load(text).values()
    its = node["ros__parameters"]["admittance"]
    mass, ratio, stiffness = (np.array(its[name]) for name in ("mass", "damping_ratio", "stiffness"))
    damping, h = ratio * 2 * np.sqrt(mass * stiffness), 1 / node["ros__parameters"]["update_rate"]
    x, v, found = 0.0, 0.0, []
    for wrench in inputs(words_of(text), scene):
        v = v + h * (wrench * its["selected_axes"] - damping * v - stiffness * x) / mass
        x = x + h * v
        found.append(x)
    return np.array(found)


def library(text, scene):
    """admittance_control: semi-implicit Euler in substeps of at most 2 ms, a three-vector for each section."""
    its = yaml.safe_load(text)["admittance_control"]
    assert its["period"] == PERIOD
    given = inputs(words_of(text), scene)
    found = np.zeros_like(given)
    for place, kind in enumerate(("force", "moment")):
        if kind not in its:
            continue
        mass, damping, stiffness = (its[kind][name] for name in ("mass", "damping", "stiffness"))
        x, v, axes = 0.0, 0.0, slice(3 * place, 3 * place + 3)
        for n, u in enumerate(given[..., axes]):
            v = v + PERIOD * (u - damping * v - stiffness * x) / mass
            x = x + PERIOD * v
            found[n, :, axes] = x
    return found


def own_controller(form):
    """A controller of one's own that reads a table and solves the equation in it exactly, axis by axis."""

    def receive(text, scene):
        if form == "json":
            tree = json.loads(text)
            said, rows = " ".join(tree.pop("law").values()), [
                (name, axis, value) for name, of in tree.items() for axis, value in of["values"].items()
            ]  # fmt: skip
        else:
            said = " ".join(words_of(text).split())
            rows = [row[:3] for row in csv.reader(line for line in text.splitlines() if line[0] != "#")][1:]
        number = {(name, axis): float(value) for name, axis, value in rows}
        given = inputs(said, scene)
        found = np.zeros_like(given)
        for place, axis in enumerate(SIX):
            if ("inertia", axis) not in number:
                continue
            mass, damping, stiffness = (number[name, axis] for name in mc.Gains.AXES)
            if "M a = w - D dxd - K dx; target dx + h dxd + h^2 a" in said:
                x, v = (motion[:, place] for motion in offsets(scene))
                a = (given[:, 0, place] - damping * v - stiffness * x) / mass
                found[:, 0, place] = x + PERIOD * v + PERIOD**2 * a
                continue
            assert re.search(r"M dxdd \+ D dxd \+ K dx = (-w|F)\b", said)
            system = np.array([[0, 1, 0], [-stiffness / mass, -damping / mass, 1 / mass], [0, 0, 0]])
            transition, state = expm(system * PERIOD), np.zeros((2, given.shape[1]))
            for n, u in enumerate(given[..., place]):
                state = (transition @ np.vstack([state, u]))[:2]
                found[n, :, place] = state[0]
        return found

    return receive


def offsets(scene):
    """The measured offset of the base from its reference (T, 6), and the base's velocity, in the reference's axes."""
    measured, reference = scene
    rotation = np.asarray(quaternion_to_matrix(jnp.asarray(reference.base_orientation[0])))
    turned = np.asarray(quaternion_to_matrix(jnp.asarray(measured.base_orientation[0])))
    turn = rotation.T @ turned  # of which twice the quaternion's vector part is sin(angle / 2) / sin(angle) of this
    vector = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    vector = vector / np.sqrt(1 + np.trace(turn))
    shift = (measured.base_position - reference.base_position) @ rotation
    velocity = np.concatenate([measured.base_linear_velocity @ rotation, measured.base_angular_velocity @ rotation], 1)
    return np.concatenate([shift, np.broadcast_to(vector, shift.shape)], axis=1), velocity


def words_of(text):
    return " ".join(line[2:] for line in text.splitlines() if line.startswith("# "))


RECEIVERS = {  # the receiver, the gains, and by how much its integration may be off
    "ros2_control": (admittance_controller, AXES, 0.08),
    "admittance_control": (library, SPLIT, 1e-9),
    "json": (own_controller("json"), AXES, 1e-9),
    "csv": (own_controller("csv"), AXES, 1e-9),
}
TAKEN = [
    (law, form) for law in LAWS for form in RECEIVERS if law != "MeasuredPoseAdmittance" or form in ("json", "csv")
]


@pytest.mark.parametrize(("law", "form"), TAKEN)
def test_a_receiver_moves_as_the_law_does(call, tmp_path, monkeypatch, scene, moved, law, form):
    """Sign, frame and axes, whether the config says which law it is or the gains file alone."""
    monkeypatch.setattr(deployment, "check", lambda *_, **__: [])  # minutes of walks
    receive, gains, off = RECEIVERS[form]
    scenario = gains_file.applied(mc.load_scenario("case_1_2", LAWS[law]), gains)
    integration = {"control.integration": "semi_implicit"} if form == "admittance_control" else {}
    base, feet = moved(scenario.with_overrides(integration))
    expected = base[:, None] if law != "EndEffectorAdmittance" else np.concatenate([feet, 0 * feet], axis=2)
    assert np.abs(expected).max() > 1e-4
    path = tmp_path / "gains.yaml"
    for named in ("in the file", "in the config"):
        gains_file.save(gains, path, law=law_of(scenario) if named == "in the file" else None)
        if named == "in the config":
            (tmp_path / "config.yaml").write_text(scenario.to_yaml())
        code, text, err = call("export", path, "--format", form)
        assert code == 0, err
        np.testing.assert_allclose(
            receive(text, scene), expected, rtol=0, atol=off * np.abs(expected).max(), err_msg=named
        )


@pytest.mark.parametrize("form", ["ros2_control", "admittance_control"])
def test_the_measured_pose_is_no_law_of_a_controllers_own(call, tmp_path, form):
    path = gains_file.save(SPLIT, tmp_path / "gains.yaml", law=mc.control.MeasuredPoseAdmittance(1.0, 1.0, 1.0))
    code, out, err = call("export", path, "--format", form)
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert "gains.yaml: law: expected VirtualModelAdmittance" in err and "MeasuredPoseAdmittance" in err


def test_where_nobody_names_the_law_that_is_said(call, tmp_path):
    code, _, err = call("export", gains_file.save(SPLIT, tmp_path / "gains.yaml"))
    assert code == 0 and "no law is named: they are taken for VirtualModelAdmittance's" in err
