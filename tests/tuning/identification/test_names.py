"""Names: each number of a log goes to the joint whose exact name it has, whatever the names look like."""

import dataclasses
import itertools
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import yaml

import mjx_climb as mc
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.robot_import.bodies import rerooted
from mjx_climb.robot_import.description import bare
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.model import RobotFile
from mjx_climb.viz.recording import save_mcap
from tests.robot import climbers
from tests.tuning.identification.recorded import ROBOT
from tuning.identification.fit import robot_files
from tuning.identification.model import replay
from tuning.identification.model.commanded import Carried
from tuning.identification.model.windows import cut
from tuning.identification.plan import output as excitation
from tuning.identification.readers import read_log, record, write_csv
from tuning.identification.readers.guess import guess
from tuning.identification.readers.log import Log, Signal, joints_of, signals_of
from tuning.identification.readers.table import Recording, Table

LIMBS = ("FL", "FR", "RL", "RR")  # as in the file; counter-clockwise, as in the model, are FL, RL, RR, FR
AT = {"FL": 0, "RL": 1, "RR": 2, "FR": 3}  # of the climber's limbs
NUMBERS = (("8", "0", "1"), ("10", "4", "5"), ("9", "2", "3"), ("11", "6", "7"))
MOTORS = tuple(tuple(f"motor_{limb}{joint}" for joint in (1, 2, 3)) for limb in (1, 2, 3, 4))
UNLIKE = tuple((f"body_leg_{n}", f"leg_{n}_1_2", f"leg_{n}_2_3") for n in range(4))
UNEVEN = (("a1", "a2", "a3", "a4"), ("b1", "b2", "b3"), ("c1", "c2", "c3", "c4"), ("d1", "d2", "d3"))
DOG = tuple(tuple(f"{limb}_{joint}_joint" for joint in ("hip", "thigh", "calf")) for limb in LIMBS)


@pytest.fixture
def own_robot(tmp_path):
    """Return what makes a scenario whose robot's file has its joints by the given names, limb by limb of `LIMBS`."""

    def make(joints):
        most = max(map(len, joints))
        text, sections = climbers.mjcf(4, most), climbers.config(tmp_path / "own.xml", 4, most)
        robot = sections["robot"] | {"limbs": {}, "locked": {}}
        for limb, own in zip(LIMBS, joints, strict=True):
            keys = sections["robot"]["limbs"][f"limb{AT[limb]}"]
            robot["limbs"][limb] = keys | {"joints": list(own)}
            for old, new in itertools.zip_longest(keys["joints"], own):
                text = text.replace(f'<joint name="{old}"', f'<joint name="{new or old}"')
                if new is None:
                    robot["locked"][old] = 0.0
        (tmp_path / "own.xml").write_text(text)
        return mc.Scenario.model_validate({"robot": robot, "gait": {"sequence": list(LIMBS)}})

    return make


def table(fields, topic="", unnamed=()):
    """Return a table of columns that move."""
    values = {field: np.sin(np.arange(9.0) + n) for n, field in enumerate(fields)}
    return Table(topic, {"time": np.arange(9.0), "log": np.arange(9.0)}, values, unnamed=set(unnamed))


def found(fields, robot, topic="", unnamed=()):
    """Return in which column each signal is found, and what is noted."""
    signals, notes = guess(Recording({topic: table(fields, topic, unnamed)}, "log"), robot)
    return {name: source.column or source.field for name, source in signals.signals.items()}, notes


@pytest.mark.parametrize(
    "joints", [NUMBERS, MOTORS, UNLIKE, UNEVEN, DOG], ids="numbers motors unlike uneven dog".split()
)
def test_exact_names_come_first_whatever_they_are(own_robot, joints):
    robot = load_robot(own_robot(joints).robot)
    own = {
        f"{limb}.{robot.joint_names[joint]}.position": name
        for limb, chain in zip(LIMBS, joints, strict=True)
        for joint, name in enumerate(chain)
    }
    for topic, form in (("/joint_states", "position.{}"), ("", "{}_pos"), ("", "q_{}"), ("", "{}")):
        expected = {signal: form.format(name) for signal, name in own.items()}
        assert found(sorted(expected.values()), robot, topic) == (expected, ())
    assert {f"{joint}.position" for joint in joints_of(robot)} == {*own}
    assert {name for name in signals_of(robot) if name.endswith(".position")} == {*own}


def test_numbers_without_names_come_in_the_order_of_the_file(own_robot):
    """Names that are numbers too: a number of a list is none's name."""
    for joints in (NUMBERS, DOG, UNEVEN):
        robot = load_robot(own_robot(joints).robot)
        fields = [f"data.{number}" for number in range(sum(map(len, joints)))]
        expected = dict(zip(
            (f"{limb}.{robot.joint_names[n]}.command" for limb, own in zip(LIMBS, joints, strict=True)
             for n in range(len(own))), fields, strict=True,
        ))  # fmt: skip
        where, (note,) = found(fields, robot, "/joint_commands", fields)
        assert where == expected
        assert "taken limb after limb, FL, FR, RL, RR, as the robot's file has them" in note


def test_names_in_topics_and_of_limbs_are_not_taken_for_numbers_of_joints(own_robot):
    robot = load_robot(own_robot(NUMBERS).robot)
    assert found(["data"], robot, "/motor_4/position") == ({f"FR.{robot.joint_names[1]}.position": "data"}, ())
    assert found(["position.4"], robot, "/robot_1/joint_states")[0] == {
        f"FR.{robot.joint_names[1]}.position": "position.4"
    }
    assert found(["wrench.force.z"], robot, "/robot_1/FL/force")[0] == {"FL.force.z": "wrench.force.z"}
    assert found(["leg4_joint3_pos"], robot)[0] == {}


def test_a_number_beside_names_is_not_read_in_their_place(own_robot):
    """A logger that counts from 0 where the file counts from 1: eleven names of twelve are some joint's."""
    joints = tuple(tuple(f"joint_{3 * limb + n + 1}" for n in range(3)) for limb in range(4))
    robot = load_robot(own_robot(joints).robot)
    where, (note,) = found([f"joint_{n}" for n in range(12)], robot)
    assert len(where) == 11 and set(where.values()) == {f"joint_{n}" for n in range(1, 12)}
    assert "joint #: 0 not read" in note


@pytest.mark.parametrize(("columns", "expected"), [
    ("q q_des qd qd_des tau tau_ff kp kd", {"position": "q", "command": "q_des", "velocity": "qd", "effort": "tau"}),
    ("q_d q dq_d dq tau_d", {"position": "q", "command": "q_d", "velocity": "dq"}),
    ("mode q dq ddq tau_est temperature lost", {"position": "q", "velocity": "dq", "effort": "tau_est"}),
    ("velocity_cmd position_cmd effort_feedforward", {"command": "position_cmd"}),
])  # fmt: skip
def test_what_is_sent_is_told_from_what_is_measured(columns, expected):
    fields = [
        f"{what}_{limb}_{joint}" for what in columns.split() for limb in ROBOT.limbs for joint in ROBOT.joint_names
    ]
    where, _ = found(fields, ROBOT)
    assert where == {
        f"{limb}.{joint}.{quantity}": f"{what}_{limb}_{joint}"
        for quantity, what in expected.items() for limb in ROBOT.limbs for joint in ROBOT.joint_names
    }  # fmt: skip


@pytest.mark.parametrize("form", ["{}.{}", "{}_{}"])
def test_columns_without_numbers_are_left_out_and_said(tmp_path, form):
    """By the names of signals, or guessed: drivers without efforts log NaN."""
    time = np.arange(20) / 10
    columns = {"time": time}
    for place, what in itertools.product(("LF.coxa", "LF.femur"), ("command", "position", "velocity", "effort")):
        columns[form.format(place, what)] = np.sin(time + len(columns))
    for name in [name for name in columns if "velocity" in name or "effort" in name]:
        columns[name] = np.where(np.arange(20) == 3, 1.0, np.nan)
    log = read_log(write_csv(tmp_path / "log.csv", columns), ROBOT)
    assert {*log.signals} == {f"LF.{joint}.{what}" for joint in ("coxa", "femur") for what in ("command", "position")}
    (said,) = log.warnings
    first = form.format("LF.coxa", "velocity")
    assert said.endswith(f"log.csv: {first} and 3 more: fewer than two numbers were recorded, left out")


def test_a_log_without_numbers_is_refused_and_so_is_a_column_that_the_user_names(tmp_path):
    path = write_csv(tmp_path / "log.csv", {"time": np.arange(5.0), "LF.coxa.position": np.full(5, np.nan)})
    with pytest.raises(mc.ConfigError, match=r"got time \(LF.coxa.position: fewer than two numbers were recorded"):
        read_log(path, ROBOT)
    (tmp_path / "signals.yaml").write_text("time: time\nsignals: {LF.coxa.position: {column: LF.coxa.position}}\n")
    with pytest.raises(mc.ConfigError, match=r"signals.yaml: signals.LF.coxa.position: expected two samples or more"):
        read_log(path, ROBOT, tmp_path / "signals.yaml")


@pytest.mark.parametrize("joints", [NUMBERS, UNEVEN], ids=["numbers", "uneven"])
def test_what_is_commanded_has_the_names_of_the_file(own_robot, joints):
    """Each column of the CSV goes out by the exact name of its joint; YAML takes no name for a number."""
    robot = load_robot(own_robot(joints).robot)
    targets = np.random.default_rng(0).standard_normal((5, *robot.joint_lower.shape))
    motion = SimpleNamespace(targets=targets, segments=[SimpleNamespace(start=0, stop=5, kp=1.0)])
    found = SimpleNamespace(robot=robot, best=SimpleNamespace(motion=motion), period=0.01, time=np.arange(5) * 0.01)
    columns, message = excitation.columns(found), yaml.safe_load(excitation.trajectory(found))
    assert message["joint_names"] == list(itertools.chain(*joints))
    rows = np.array([point["positions"] for point in message["points"]])
    for limb, own in zip(LIMBS, joints, strict=True):
        for joint, name in zip(robot.joint_names, own, strict=False):
            values = rows[:, message["joint_names"].index(name)]
            np.testing.assert_allclose(values, columns[f"{limb}.{joint}.command"], atol=1e-6)
    assert set(columns) == {"time", "control.kp", "torque_off", *(f"{joint}.command" for joint in joints_of(robot))}


def test_a_limb_of_fewer_joints_is_fitted_by_the_commands_of_those_it_has(own_robot):
    robot = load_robot(own_robot(UNEVEN).robot)
    time = np.arange(300) / 100
    signals = {
        f"{joint}.{what}": Signal(time, np.sin(time)) for joint in joints_of(robot) for what in ("command", "position")
    }
    assert {*cut(Log(signals, "log"), robot, 0.001, 0.2).limb} == {0, 1, 2, 3}


@pytest.mark.parametrize("joints", [NUMBERS, UNEVEN], ids=["numbers", "uneven"])
def test_the_file_of_an_identified_robot_keeps_the_names_and_the_order(own_robot, tmp_path, joints):
    source = own_robot(joints).robot
    robot = load_robot(source)
    section = robot_files.write(source, robot, tmp_path / "identified.xml")
    read = load_robot(RobotFile.model_validate(section))
    assert (read.joints_in_file, read.limbs, read.joint_names) == (robot.joints_in_file, robot.limbs, robot.joint_names)
    for field in ("link_mass", "frame_position", "foot_center", "stance_joints"):
        np.testing.assert_allclose(getattr(read, field), getattr(robot, field), atol=1e-5, err_msg=field)


@pytest.mark.parametrize("root", ["footprint", "a foot"])
def test_a_viewer_puts_the_file_of_the_robot_where_the_walk_is(own_robot, tmp_path, root):
    """By the names in /joint_states, and /tf of the root link alone, MuJoCo's feet are those of the walk."""
    scenario, file = own_robot(UNEVEN), tmp_path / "own.xml"
    text = (
        file.read_text()
        .replace("</worldbody>", "</body></worldbody>")
        .replace(
            '<body name="trunk"><freejoint/>',
            '<body name="footprint" euler="0 0 30"><freejoint/><body name="trunk" pos="0.1 0 0.05" euler="10 0 0">',
        )
    )
    file.write_text(text.replace('<site name="foot0"', '<body name="FL_foot"/><site name="foot0"'))
    changes = {"locked": {"L3_3": 0.3, "L2_3": -0.2}}
    if root == "a foot":
        root = "L0_2"
        (tmp_path / "turned.xml").write_text(rerooted(bare(str(file)).compile(), root).to_xml())
        changes |= {"file": str(tmp_path / "turned.xml"), "base": "trunk"}
    robot = RobotFile.model_validate(scenario.robot.model_dump() | changes)
    scenario = scenario.model_copy(update={"robot": robot})
    walk = somewhere(scenario)
    tables = record(save_mcap(walk, tmp_path / "walk.mcap")).tables
    frames = dict.fromkeys(field.split(".")[1] for field in tables["/tf"].fields)
    model = mujoco.MjModel.from_xml_path(robot.file)
    links = {model.body(body).name for body in range(model.nbody)}
    assert next(iter(frames)) == root == model.body(1).name and links & {*frames} == {root}
    state, data = tables["/joint_states"].fields, mujoco.MjData(model)
    hinges = [model.joint(joint).name for joint in range(model.njnt) if model.jnt_type[joint] == 3]
    assert {f"position.{name}" for name in hinges} == {field for field in state if field.startswith("position.")}
    for name in hinges:
        data.joint(name).qpos[:] = state[f"position.{name}"][0]
    mujoco.mj_kinematics(model, data)
    placed = {
        axis: column[0] for axis, column in tables["/tf"].fields.items() if axis.startswith(f"transforms.{root}.")
    }
    at, turned = (
        np.array([value for name, value in placed.items() if part in name]) for part in ("translation", "rotation")
    )
    body, turn = model.body(root).id, np.zeros(9)
    mujoco.mju_quat2Mat(turn, turned[[3, 0, 1, 2]])
    seen = (data.site_xpos - data.xpos[body]) @ data.xmat[body].reshape(3, 3)
    places = seen @ turn.reshape(3, 3).T + at
    feet = [model.site(f"foot{AT[limb]}").id for limb in walk.limbs]
    np.testing.assert_allclose(places[feet], walk.foot_position[0], atol=1e-5)


def somewhere(scenario):
    """Return a walk of two rows with the base and the joints anywhere."""
    robot, draw = load_robot(scenario.robot), np.random.default_rng(0)
    angles = robot.stance_joints + draw.uniform(-0.2, 0.2, (2, *robot.stance_joints.shape))
    none = np.zeros((2, len(robot.limbs), 3))
    walk = replay._as_walk(
        scenario, robot, own_parameters(scenario), angles, Carried(angles, 0 * angles, 0 * angles, none)
    )
    turned = draw.standard_normal((2, 4))
    base = {
        "base_position": draw.standard_normal((2, 3)),
        "base_orientation": turned / np.linalg.norm(turned, axis=1, keepdims=True),
    }
    return dataclasses.replace(walk, **base, foot_position=replay._feet(robot, *base.values(), angles))


def test_of_limbs_whose_names_begin_alike_the_longest_is_meant():
    names = ("arm", "arm_left", "left_arm_left", "leg")
    in_file = tuple((limb, tuple(f"axis{n}{j}" for j in "abc")) for n, limb in enumerate(names))
    robot = dataclasses.replace(ROBOT, limbs=names, joints_in_file=in_file)
    where, _ = found([f"position_{limb}_coxa" for limb in names], robot)
    assert where == {f"{limb}.coxa.position": f"position_{limb}_coxa" for limb in names}
