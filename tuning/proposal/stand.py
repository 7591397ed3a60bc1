"""A robot on a stand from its file: its base is held, its limbs are rows of joints, and nothing walks."""

import os
from collections.abc import Mapping
from typing import Any

from mjx_climb.robot.constants import RobotError
from mjx_climb.robot_import.bodies import joints_of, rigid_parts, robot_in
from mjx_climb.robot_import.description import JOINTS
from tuning.proposal.limbs import MOST_JOINTS


def on_stand(file: str | os.PathLike[str], base: str | None = None) -> Mapping[str, Any]:
    """The section `robot` of a scenario: each row of joints from the base outwards is a limb.

    Raises:
        RobotError: a file that MuJoCo does not load, no joints, or a row that branches or has more than seven.
    """
    model = robot_in(str(file), base)
    part = rigid_parts(model)
    moving = [joint for joint in range(model.njnt) if int(model.jnt_type[joint]) in JOINTS]
    links = sorted({int(model.jnt_bodyid[joint]) for joint in moving})
    inner = {link: int(part[model.body_parentid[link]]) for link in links}
    if not moving:
        raise RobotError(f"{file}: expected joints that turn or slide, got none")
    limbs: dict[str, Any] = {}
    for first in (link for link in links if inner[link] not in links):
        row, link = [first], first
        while outer := [other for other in links if inner[other] == link]:
            if len(outer) > 1:
                names = " and ".join(model.body(other).name for other in outer)
                raise RobotError(f"{file}: expected rows of joints, got {names} on {model.body(link).name}")
            row, link = [*row, outer[0]], outer[0]
        joints = [model.joint(joint).name for link in row for joint in joints_of(model, link)]
        if len(joints) > MOST_JOINTS:
            raise RobotError(f"{file}: expected one to {MOST_JOINTS} joints in a row, got {', '.join(joints)}")
        limbs[model.body(first).name] = {"joints": joints}
    section: dict[str, Any] = {"file": os.path.abspath(file), "limbs": limbs}
    return section if base is None else {**section, "base": base}
