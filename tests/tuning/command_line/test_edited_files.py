"""A robot's file, one that it includes, and a mesh, edited under the same name: commands answer for the new robot."""

import json

import numpy as np
import pytest
import yaml

import mjx_climb as mc
from tests.shell import finish
from tuning.identification.readers import write_csv
from tuning.problem import evaluation

LINK = '<inertial pos="0 0 -0.05" mass="{}" diaginertia="1e-4 1e-4 1e-4"/>'
LIMB = """<body name="{0}1" pos="0 {1} 0"><joint name="{0}_hip" axis="0 -1 0" range="-2 2" limited="true"/>{2}
  <body name="{0}2" pos="0.05 0 -0.1"><joint name="{0}_knee" axis="0 -1 0" range="-2 2" limited="true"/>{3}
    <site name="{0}_foot" pos="0.05 0 -0.05"/></body></body>"""
ROBOT = """<mujoco><compiler angle="radian"/><option gravity="0 0 -9.8"/>
<asset><mesh name="shin" file="shin.obj"/></asset>
<worldbody><body name="base" pos="0 0 0.2"><freejoint/><inertial pos="0 0 0" mass="{}" diaginertia="0.01 0.01 0.01"/>
<include file="limb.xml"/>{}</body></worldbody></mujoco>"""
BOX = "".join(f"v {x} {y} {z}\n" for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)) + "".join(
    f"f {face}\n" for face in (
        "1 2 4", "1 4 3", "5 7 8", "5 8 6", "1 5 6", "1 6 2", "3 4 8", "3 8 7", "1 3 7", "1 7 5", "2 6 8", "2 8 4")
)  # fmt: skip
CONFIG = {
    "gravity": [0.0, 0.0, -1.0], "duration": 0.1, "time_step": 0.001, "control": {"kp": 20.0, "kd": 0.5},
    "gait": {"sequence": ["A", "B"], "cycle": 0.1, "duty": 0.7, "stride": 0.001, "step_height": 0.01},
    "contact": {"stiffness": 3000.0, "damping": 10.0, "rotational_stiffness": 5.0, "rotational_damping": 0.01},
    "hardware": {"servo": {"armature": 0.002}},
    "robot": {"file": "robot.xml", "height": 0.14, "limbs": {
        limb: {"joints": [f"{limb}_hip", f"{limb}_knee"], "foot": f"{limb}_foot", "foothold": [0.1, y]}
        for limb, y in (("A", 0.1), ("B", -0.1))}},
}  # fmt: skip
GAINS = {"inertia": 1.0, "damping": 100.0, "stiffness": 2000.0}
LOG = ["--log", "{folder}/log.csv", "--base", "held"]
COMMANDS = {
    "run": ["run", "{config}", "--json"],
    "sweep": ["sweep", "{config}", "--stiffness", "1000:2000:2", "--damping", "100:200:2", "--json", "--out", "{out}"],
    "tune": ["tune", "{config}", "--iterations", "2", "--starts", "1", "--json", "--out", "{out}"],
    "margins": ["evaluate", "{config}", "--gains", "{gains}", "--margins", "--json", "--out", "{out}"],
    "ceiling": ["evaluate", "{config}", "--gains", "{gains}", "--ceiling", "--knots", "0.1", "--iterations", "2",
                "--json", "--out", "{out}"],
    "excite": ["excite", "{config}", "--fit", "hardware.servo.armature", "--duration", "2", "--candidates",
               "1", "--json", "--out", "{out}"],
    "identify": ["identify", "{config}", *LOG, "--fit", "hardware.servo.armature", "--starts", "1", "--json"],
    "replay": ["replay", "{config}", *LOG, "--json"],
}  # fmt: skip


def write(folder, base=1.0, included=0.1, mesh=0.02):
    """Write a robot of two limbs: one included, the other with a shin whose mass is that of its mesh."""
    shin = '<geom type="mesh" mesh="shin" density="1000"/>'
    (folder / "limb.xml").write_text(
        f"<mujocoinclude>{LIMB.format('A', 0.1, LINK.format(included), LINK.format(0.05))}</mujocoinclude>"
    )
    vertices, faces = BOX.partition("f")[::2]
    scaled = "".join(
        "v " + " ".join(f"{mesh * float(x):.6g}" for x in line.split()[1:]) + "\n" for line in vertices.splitlines()
    )
    (folder / "shin.obj").write_text(f"{scaled}f{faces}")
    (folder / "robot.xml").write_text(ROBOT.format(base, LIMB.format("B", -0.1, LINK.format(0.1), shin)))


@pytest.fixture
def asked(tmp_path):
    """Arguments of a command, each time with a new folder for what it writes."""
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(CONFIG))
    (tmp_path / "gains.yaml").write_text(yaml.safe_dump(GAINS))
    time = np.arange(250) / 100
    columns = {
        f"{limb}.{joint}.{kind}": 0.2 * np.sin(5 * (time - late) + n)
        for n, limb in enumerate("AB")
        for joint in ("hip", "knee")
        for kind, late in (("command", 0.0), ("position", 0.03))
    }
    write_csv(tmp_path / "log.csv", {"time": time, **columns})
    count = iter(range(99))

    def arguments(command):
        places = {"folder": tmp_path, "config": tmp_path / "config.yaml", "gains": tmp_path / "gains.yaml"}
        out = tmp_path / f"out{next(count)}"
        return [each.format(**places, out=out) for each in COMMANDS[command]]

    return arguments


def numbers(printed):
    """All numbers in a JSON text but for times of the clock, in their order."""
    found = []

    def gather(value, key=""):
        if isinstance(value, dict):
            for name, each in value.items():
                gather(each, name)
        elif isinstance(value, list):
            for each in value:
                gather(each, key)
        elif isinstance(value, float) and "seconds" not in key:
            found.append(value)

    gather(json.loads(printed))
    return found


def alike(one, other):
    return len(one) == len(other) and np.allclose(one, other, rtol=1e-4, atol=0, equal_nan=True)


NEW = {"base": 1.5, "included": 0.2, "mesh": 0.025}


@pytest.mark.parametrize("command", [
    pytest.param(command, marks=pytest.mark.slow if command == "replay" else pytest.mark.nightly)
    for command in COMMANDS
])  # fmt: skip
def test_an_edited_robot_is_answered_for_as_with_an_empty_cache(command, asked, call, tmp_path):
    """Of a walk each edit is seen by itself.

    Programs of another process round otherwise, in single precision to 3e-6; an answer for an old robot is far off.
    """
    every = [dict([*NEW.items()][:n]) for n in range(4)] if command == "run" else [{}, NEW]
    answers = []
    for edited in every:
        write(tmp_path, **edited)
        code, out, err = call(*asked(command))
        assert code == 0, err
        answers.append(numbers(out))
    assert not any(alike(one, other) for n, one in enumerate(answers) for other in answers[:n])
    fresh, _ = finish(*asked(command), MJX_CLIMB_CACHE=str(tmp_path / "empty"))
    assert alike(numbers(fresh), answers[-1])


@pytest.mark.slow
def test_pd_of_an_edited_robot_walks_anew_in_the_same_process(tmp_path):
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(CONFIG))
    found = []
    for edited in ({}, NEW):
        write(tmp_path, **edited)
        found.append(evaluation.baseline(mc.load_scenario(tmp_path / "config.yaml"))["force_variation"])
    assert abs(found[1] / found[0] - 1) > 0.01
