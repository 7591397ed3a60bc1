"""A robot that was identified as an MJCF, and the section `robot` of a scenario that names it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjx_climb.files.dataset import write_text_atomically
from mjx_climb.mujoco_import import mujoco
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.robot.constants import Robot
from mjx_climb.robot_import.load import load_robot, load_spec
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import RobotFile

_DRIVES = {"armature": "armature", "damping": "damping", "friction": "frictionloss"}  # MuJoCo's names


def write(source: str | RobotFile, robot: Robot, path: Path) -> dict[str, Any]:
    """Write a robot whose constants differ from its file's in masses, centres, inertias, drives or joint zeros.

    Its joints keep the names of the robot's own file, by which logs and commands know them.

    Returns:
        The section `robot` of a scenario.

    Raises:
        ConfigError: a robot with springs or joints that only fill up a limb.
        OutputError: the file cannot be written.
    """
    nominal = load_robot(source)
    if nominal.driven is not None or nominal.spring is not None:
        raise ConfigError("", "robot", "one whose joints are all driven, to write its file", "springs")
    spec = load_spec(source)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[3] = 1.0
    mujoco.mj_kinematics(model, data)
    for key in list(spec.keys):
        spec.delete(key)
    for n, limb in enumerate(nominal.limbs):
        rotation = np.eye(3)
        for j, joint in enumerate(nominal.joint_names):
            name = f"{limb}_{joint}"
            rotation = rotation @ nominal.frame_rotation[n, j]
            body, moved = spec.body(name), spec.joint(name)
            at, own = data.xanchor[model.joint(name).id], data.xmat[model.body(name).id].reshape(3, 3)
            to_body = own.T @ rotation
            center = own.T @ (at - data.xpos[model.body(name).id]) + to_body @ robot.link_center[n, j]
            inertia = to_body @ robot.link_inertia[n, j] @ to_body.T
            _weigh(body, robot.link_mass[n, j], center, inertia)
            turn = nominal.frame_rotation[n, j].T @ robot.frame_rotation[n, j]
            zero = float(np.arctan2(turn[1, 0], turn[0, 0]))
            _turn(body, model.body(name).quat, model.joint(name).axis, zero)
            for field, theirs in _DRIVES.items():
                if (values := getattr(robot, field)) is not None:
                    value = float(values[n, j])
                    setattr(moved, theirs, [value, 0, 0] if theirs == "damping" else value)
    base, center = spec.body(model.body(1).name), nominal.frame_position[0, 0] - robot.frame_position[0, 0]
    _weigh(base, robot.base_mass, model.body_ipos[1] + center, robot.base_inertia)
    for limb, own in nominal.joints_in_file:
        _name(spec, limb, nominal.joint_names, own)
    spec.compile()
    write_text_atomically(path, spec.to_xml())
    return _section(robot, path, center)


def _name(spec: mujoco.MjSpec, limb: str, simulated: Sequence[str], own: Sequence[str]) -> None:
    """Give a limb's joints their own names in place of the simulated, and leave out those that only fill it up."""
    for old, new in zip(simulated, own, strict=False):
        spec.joint(f"{limb}_{old}").name = new
    if filling := simulated[len(own) :]:
        foot = np.array(spec.body(f"{limb}_{filling[0]}").pos)
        spec.delete(spec.body(f"{limb}_{filling[0]}"))
        spec.body(f"{limb}_{simulated[len(own) - 1]}").add_site(name=f"{limb}_foot", pos=foot)


def _weigh(body: mujoco.MjsBody, mass: np.ndarray, center: np.ndarray, inertia: np.ndarray) -> None:
    body.explicitinertial, body.mass, body.ipos, body.iquat = True, float(mass), center, [1, 0, 0, 0]
    body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def _turn(body: mujoco.MjsBody, quaternion: np.ndarray, axis: np.ndarray, angle: float) -> None:
    """Turn a body about the axis of its joint, which stands at the body's origin."""
    if angle:
        turned, about = np.zeros(4), np.r_[np.cos(angle / 2), np.sin(angle / 2) * axis]
        mujoco.mju_mulQuat(turned, quaternion, about)
        body.quat = turned


def _section(robot: Robot, path: Path, center: np.ndarray) -> dict[str, Any]:
    """Return the section; height and footholds are of the base link's frame, `center` (3,) m off its centre of mass."""
    rotation = quaternion_to_matrix(robot.stance_orientation)
    feet = limb_frames(robot, rotation, robot.stance_joints).foot + rotation @ center
    places = {
        limb: [round(float(value), 9) for value in foot[:2]] for limb, foot in zip(robot.limbs, feet, strict=True)
    }
    limbs = {
        limb: {"joints": list(own), "foot": f"{limb}_foot", "foothold": places[limb]}
        for limb, own in robot.joints_in_file
    }
    return {"file": str(path.absolute()), "height": float(robot.stance_position[2]), "limbs": limbs}
