"""A walk as a recording of ROS 2: every message of a walk of random numbers, read by rosbags."""

import dataclasses

import mujoco
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

import mjx_climb as mc
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.model import RobotFile
from mjx_climb.viz.recording import save_mcap
from tests.robot import climbers
from tests.trajectories import still

HOLDS = {
    "points": [{"at": [0.1, 0.2, 0.0], "normal": [0, 0.6, 0.8], "limit": 3.0}, {"at": [-0.1, 0.2, 0.3]}],
    "count": 5,
}
QUANTITIES = (
    "joint_angles", "joint_rates", "joint_torque", "joint_targets", "foot_force", "foot_moment", "foot_position",
    "base_position", "base_linear_velocity", "base_angular_velocity", "push", "base_orientation",
)  # fmt: skip


def drawn(scenario, seed=0):
    """A walk of random numbers."""
    draw, walk = np.random.default_rng(seed), still(scenario)
    series = {name: draw.normal(size=getattr(walk, name).shape) for name in QUANTITIES}
    series["base_orientation"] /= np.linalg.norm(series["base_orientation"], axis=1, keepdims=True)
    support = draw.random(walk.support.shape) < 0.5
    return dataclasses.replace(walk, support=support, **series)


def messages(path):
    """Return types, and stamps and messages by topic."""
    found, kinds = {}, {}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, stamp, raw in reader.messages():
            kinds[connection.topic] = connection.msgtype.rpartition("/")[2]
            found.setdefault(connection.topic, []).append((stamp, reader.deserialize(raw, connection.msgtype)))
    return kinds, found


def numbers(message):
    """All numbers in a message or a part of it, in the order of its fields; a quaternion's as wxyz."""
    own = vars(message)
    if {*own} >= {"x", "y", "z", "w"}:
        return [message.w, message.x, message.y, message.z]
    return [
        v
        for name, value in own.items()
        if name != "__msgtype__"
        for v in (numbers(value) if hasattr(value, "__msgtype__") else [value])
    ]


@pytest.mark.parametrize("time_step", [0.001, 0.004, 0.025])
def test_every_message_has_the_numbers_of_its_row(tmp_path, time_step):
    scenario = mc.Scenario().with_overrides({
        "time_step": time_step, "duration": 40 * time_step, "gait.cycle": 40 * time_step, "ground.holds": HOLDS,
    })  # fmt: skip
    walk = drawn(scenario)
    path = save_mcap(walk, tmp_path / "walk.mcap")
    assert path == tmp_path / "walk.mcap"
    kinds, found = messages(path)
    limbs, joints = walk.limbs, [f"{limb}_{joint}" for limb in walk.limbs for joint in walk.robot.joint_names]
    assert kinds == {
        "/joint_states": "JointState", "/joint_commands": "JointState", "/base_pose": "PoseStamped",
        "/base_twist": "TwistStamped", "/push": "WrenchStamped", "/tf": "TFMessage", "/holds": "PointCloud2",
        **{f"/{limb}/force": "WrenchStamped" for limb in limbs}, **{f"/{limb}/support": "Bool" for limb in limbs},
    }  # fmt: skip
    stamps = [round(1e9 * t) for t in walk.time]
    frames = stamps[:: max(round(0.01 / time_step), 1)]
    for topic, each in found.items():
        expected = {"/tf": frames, "/holds": stamps[:1]}.get(topic, stamps)
        assert [stamp for stamp, _ in each] == expected, topic
        for stamp, message in each:
            header = message.transforms[0].header if topic == "/tf" else getattr(message, "header", None)
            if header is not None:
                assert (header.stamp.sec, header.stamp.nanosec, header.frame_id) == (*divmod(stamp, 10**9), "world")
    for row in range(len(stamps)):
        now = {topic: each[row][1] for topic, each in found.items() if topic not in ("/tf", "/holds")}
        state, sent = now["/joint_states"], now["/joint_commands"]
        assert state.name == sent.name == joints
        np.testing.assert_array_equal(state.position, walk.joint_angles[row].ravel())
        np.testing.assert_array_equal(state.velocity, walk.joint_rates[row].ravel())
        np.testing.assert_array_equal(state.effort, walk.joint_torque[row].ravel())
        np.testing.assert_array_equal(sent.position, walk.joint_targets[row].ravel())
        assert not len(sent.velocity) and not len(sent.effort)
        for n, limb in enumerate(limbs):
            both = [*walk.foot_force[row, n], *walk.foot_moment[row, n]]
            np.testing.assert_array_equal(numbers(now[f"/{limb}/force"].wrench), both)
            assert now[f"/{limb}/support"].data == walk.support[row, n]
        pose = [*walk.base_position[row], *walk.base_orientation[row]]
        np.testing.assert_array_equal(numbers(now["/base_pose"].pose), pose)
        twist = [*walk.base_linear_velocity[row], *walk.base_angular_velocity[row]]
        np.testing.assert_array_equal(numbers(now["/base_twist"].twist), twist)
        np.testing.assert_array_equal(numbers(now["/push"].wrench), walk.push[row])
    for stamp, message in found["/tf"]:
        row = stamps.index(stamp)
        assert [each.child_frame_id for each in message.transforms] == ["base", *(f"{limb}_foot" for limb in limbs)]
        base, *feet = (numbers(each.transform) for each in message.transforms)
        np.testing.assert_array_equal(base, [*walk.base_position[row], *walk.base_orientation[row]])
        for n, foot in enumerate(feet):
            np.testing.assert_array_equal(foot, [*walk.foot_position[row, n], 1, 0, 0, 0])
    ((_, cloud),) = found["/holds"]
    assert [(f.name, f.offset, f.datatype, f.count) for f in cloud.fields] == [
        (name, 4 * n, 7, 1) for n, name in enumerate(["x", "y", "z", "normal_x", "normal_y", "normal_z", "limit"])
    ]
    points = np.frombuffer(cloud.data.tobytes(), "<f4").reshape(-1, 7)
    np.testing.assert_allclose(points, [[0.1, 0.2, 0, 0, 0.6, 0.8, 3], [-0.1, 0.2, 0.3, 0, 0, 1, np.inf]], rtol=1e-6)
    shape = (cloud.height, cloud.width, cloud.point_step, cloud.row_step, cloud.is_bigendian, cloud.is_dense)
    assert shape == (1, 2, 28, 56, False, True)
    assert save_mcap(walk, tmp_path / "again.mcap").read_bytes() == path.read_bytes()


def test_joints_that_are_held_are_told_and_feet_are_called_as_no_link_is(tmp_path):
    """A robot of the user's: the last joints are held, and a link has the name that a foot would have."""
    text = climbers.mjcf(4, 4).replace('<site name="foot1"', '<body name="limb1_foot"/><site name="foot1"')
    (tmp_path / "own.xml").write_text(text)
    data = climbers.config(tmp_path / "own.xml", 4, 4)
    held = {f"L{limb}_3": 0.3 - 0.1 * limb for limb in range(4)}
    for limb in data["robot"]["limbs"].values():
        limb["joints"].pop()
    data["robot"] |= {"locked": held}
    scenario = mc.Scenario.model_validate(data).with_overrides({"duration": 0.01})
    robot = load_robot(RobotFile.model_validate(data["robot"]))
    walk = dataclasses.replace(drawn(scenario), limbs=robot.limbs)
    _, found = messages(save_mcap(walk, tmp_path / "walk.mcap"))
    state = found["/joint_states"][3][1]
    places = robot.places_in_file()
    assert state.name == [*places, *held] and found["/joint_commands"][3][1].name == [*places]
    angles = [*(walk.joint_angles[3][place] for place in places.values()), *held.values()]
    np.testing.assert_array_equal(state.position, angles)
    assert not state.velocity[-4:].any() and not state.effort[-4:].any() and state.velocity[:-4].all()
    frames = [each.child_frame_id for each in found["/tf"][0][1].transforms]
    assert frames == ["trunk", *(f"{limb}_foot_contact" for limb in robot.limbs)]


def test_the_root_link_of_a_robot_is_where_mujoco_has_it(tmp_path):
    """Its base is two bodies with a joint between them that is held, and limbs have names that ROS does not take."""
    text = climbers.mjcf(4, 3).replace('<body name="trunk">', '<body name="trunk" pos="0.1 0.2 0.3" euler="10 20 30">')
    chest = '<body name="chest" pos="0 0 0.05"><joint name="neck" axis="0 1 0"/>'
    chest += '<inertial pos="0 0 0" mass="1" diaginertia="1e-3 1e-3 1e-3"/></body>'
    text = text.replace('<body name="L3_0"', f'{chest}<body name="L3_0"')
    (tmp_path / "own.xml").write_text(text)
    data = climbers.config(tmp_path / "own.xml", 4, 3)
    limbs = {f"limb {n}-a": limb for n, limb in enumerate(data["robot"]["limbs"].values())}
    data["robot"] |= {"locked": {"neck": 0.4}, "limbs": limbs}
    data["gait"]["sequence"] = [*limbs]
    scenario = mc.Scenario.model_validate(data).with_overrides({"duration": 0.01, "gait.cycle": 0.01})
    robot = load_robot(scenario.robot)
    walk = dataclasses.replace(drawn(scenario), limbs=robot.limbs)
    _, found = messages(save_mcap(walk, tmp_path / "walk.mcap"))
    assert {f"/limb_{n}_a/force" for n in range(4)} <= {*found}
    model = mujoco.MjModel.from_xml_string(text)
    state = mujoco.MjData(model)
    state.joint("neck").qpos[:] = 0.4
    trunk = [model.body("trunk").id, model.body("chest").id]
    mass = model.body_mass[trunk]
    mujoco.mj_kinematics(model, state)
    for name, place in robot.places_in_file().items():
        state.joint(name).qpos[:] = walk.joint_angles[0][place]
    # the base of the walk is the centre of mass of trunk and chest, along the axes of the trunk
    state.qpos[3:7] = walk.base_orientation[0]
    mujoco.mj_kinematics(model, state)
    centre = mass @ state.xipos[trunk] / mass.sum()
    root = found["/tf"][0][1].transforms[0]
    assert root.child_frame_id == "trunk"
    place = walk.base_position[0] + state.xpos[trunk[0]] - centre
    np.testing.assert_allclose(numbers(root.transform.translation), place, atol=1e-9)
    turned = np.array(numbers(root.transform.rotation))
    assert abs(turned @ walk.base_orientation[0]) == pytest.approx(1, abs=1e-9)
