"""Robots by name or from a file of the user's own, and the check of their rest stance."""

import dataclasses
import functools
import os
from pathlib import Path

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.physics.postures import MET, SINGULAR, keeps_attitude, least_singular_values, limb_joints
from mjx_climb.reading import until_edited
from mjx_climb.robot.constants import Robot, RobotError, robot_from_model
from mjx_climb.robot_import.description import files_of
from mjx_climb.robot_import.robot_file import refusal, unposed
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import RobotFile, Scenario

_MODELS = Path(__file__).parents[1] / "robot" / "models"


def model_path(name: str | RobotFile) -> Path:
    """Return the file of a robot: a user's own, or the MJCF of one that comes with mjx_climb.

    Raises:
        RobotError: no such robot.
    """
    if isinstance(name, RobotFile):
        return Path(name.file)
    path = _MODELS / f"{name}.xml"
    if not os.path.isfile(path):
        known = ", ".join(sorted(p.stem for p in _MODELS.glob("*.xml")))
        raise RobotError(f"robot: expected one of {known}, got {name!r}")
    return path


def load_model(name: str | RobotFile) -> mujoco.MjModel:
    """The compiled MuJoCo model of a robot: one that comes with mjx_climb, or one from a file."""
    return load_robot(name).model


def load_spec(name: str | RobotFile) -> mujoco.MjSpec:
    """The editable description of `load_model`."""
    if isinstance(name, RobotFile):
        return spec_of(name)
    return mujoco.MjSpec.from_file(str(model_path(name)))


def _files(name: str | RobotFile) -> list[Path]:
    """The files that a robot may be read from."""
    file = model_path(name)
    own = isinstance(name, RobotFile) and file.suffix == ".xml" and file.is_file()
    return sorted(files_of(file)) if own else [file]


@until_edited(_files)
def load_robot(name: str | RobotFile) -> Robot:
    """The constants of a robot, from its MuJoCo model with the joints at zero; its files are read again once edited.

    Raises:
        RobotError: no such robot, or a model other than a floating base with limbs of as many joints each and a foot.
    """
    model = load_spec(name).compile()
    if isinstance(name, str):
        return robot_from_model(model, name)
    robot = robot_from_model(model, Path(name.file).stem)
    # as the section lists them: `mjx-climb robot` writes them in the file's order
    return dataclasses.replace(robot, joints_in_file=tuple((limb, own.joints) for limb, own in name.limbs.items()))


def spec_of(source: RobotFile) -> mujoco.MjSpec:
    """Return a robot file as simulated, see `unposed`, in its rest stance.

    Raises:
        RobotError: in one line, the key of the config, the expected and the found.
    """
    spec, robot, offset = unposed(source)
    if source.height is None:
        position = spec.body("base").pos
        spec.add_key(name="stance", qpos=[*position, 1, 0, 0, 0, *np.zeros(robot.stance_joints.size)])
        return spec
    limbs = dict(source.limbs.items())
    feet = np.array([[*limbs[name].foothold, -source.height] for name in robot.limbs]) - offset
    joints = limb_joints(robot, feet)
    for limb, error in zip(robot.limbs, joints.errors, strict=True):
        if error > MET:
            expected = f"a foothold within reach and joint limits at a height of {source.height:g} m"
            got = f"one that the foot misses by {error * 1e3:.3g} mm" if np.isfinite(error) else "one beyond the limits"
            raise refusal(source, f"limbs.{limb}.foothold", expected, got)
    position = [offset[0], offset[1], source.height + offset[2]]
    spec.add_key(name="stance", qpos=[*position, 1, 0, 0, 0, *joints.angles.ravel()])
    spec.body("base").pos = position
    return spec


def check_stance(scenario: Scenario, source: str = "scenario") -> None:
    """Refuse a stand, and a stance with a singular limb: it cannot move its foot every way, or turn it.

    Raises:
        ConfigError: in one line, the key; or the limb and the smallest singular value of its Jacobian.
    """
    if isinstance(scenario.robot, RobotFile) and scenario.robot.on_stand:
        raise ConfigError(source, "robot.height", "a height, to walk", "null: a robot on a stand")
    if wrong := _singular_limb(load_robot(scenario.robot), scenario.value("contact.rotational_stiffness", 0.0) > 0):
        raise wrong.moved(source=source)


@functools.lru_cache(maxsize=64)
def _singular_limb(robot: Robot, moments: bool) -> ConfigError | None:
    turned = moments and keeps_attitude(robot)
    values = least_singular_values(robot, robot.stance_joints, turned)
    limb, least, does = robot.limbs[values.argmin()], values.min(), "move and turn" if turned else "move"
    if least >= SINGULAR:
        return None
    key, expected = f"robot.limbs.{limb}.foothold", f"a stance in which the limb can {does} its foot every way"
    got = f"a singular one (smallest singular value of its Jacobian {least:.2g}, lengths over the limb's)"
    return ConfigError("", key, expected, f"{got}: another height or foothold")
