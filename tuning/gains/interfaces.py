"""The input of each exported law and its output: sign, frame and axes, for the author of a controller."""

import dataclasses
import textwrap
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

import mjx_climb as mc
from mjx_climb.control import EndEffectorAdmittance, MeasuredPoseAdmittance, VirtualModelAdmittance

_WIDTH = 116
FRAME = "the axes of the base reference (x ahead, z along the ground's normal)"
_WRENCH = "w the sum of the ground's forces on the feet and of their moments about the base's centre of mass"


class Interface(NamedTuple):
    """A law as a controller on the robot has it."""

    equation: str
    drive: str  # the input, with its sign
    measured: str  # the meaning of its symbol
    moves: str
    axes: int = 6  # three translations, three rotations; 3: translations alone

    @property
    def driven_by(self) -> str:
        """The input in words, with its frame."""
        return f"{self.drive}, {self.measured}, in {FRAME}"


INTERFACES: Mapping[type[mc.Law], Interface] = {
    VirtualModelAdmittance: Interface(
        "M dxdd + D dxd + K dx = -w", "-w", _WRENCH, "dx shifts the base from its reference."
    ),
    MeasuredPoseAdmittance: Interface(
        "M a = w - D dxd - K dx; target dx + h dxd + h^2 a", "+w", _WRENCH,
        "dx is the measured offset of the base from its reference, dxd its rate, h the period; the base is sent to the "
        "target.",
    ),
    EndEffectorAdmittance: Interface(
        "M dxdd + D dxd + K dx = F", "+F", "F the force of the ground on the foot",
        "One instance for each foot: dx shifts the foot from its reference while its gripper holds, and begins at 0 "
        "each time that the gripper shuts.",
        axes=3,
    ),
}  # fmt: skip


def of_law(gains: mc.Gains, law: type[mc.Law]) -> mc.Gains:
    """Return gains of six axes each, where the rotations that a law has not are like its translations."""
    axes = INTERFACES[law].axes
    six = {name: np.broadcast_to(np.asarray(getattr(gains, name), float), 6) for name in mc.Gains.AXES}
    return dataclasses.replace(gains, **{name: np.tile(values[:axes], 6 // axes) for name, values in six.items()})


def comment(law: type[mc.Law], before: str) -> str:
    """Return the input and output of a law as lines of a comment, behind some words."""
    own = INTERFACES[law]
    return "\n".join(textwrap.wrap(f"{before} {own.driven_by}. {own.moves}", _WIDTH))
