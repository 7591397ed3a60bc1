"""Control laws behind one seam: measurement and reference go in, targets of base and feet come out.

A law is a class in a file of this folder; its name is the one that --law, a gains file and `own.law.name` take.
"""

import functools
import importlib
import inspect
import math
import pkgutil
from typing import Any

from mjx_climb.control.base_admittance import MeasuredPoseAdmittance, VirtualModelAdmittance
from mjx_climb.control.combined import Made, combined
from mjx_climb.control.end_effector_admittance import EndEffectorAdmittance
from mjx_climb.control.law import (
    PD,
    Command,
    JointGains,
    Law,
    Measurement,
    Reference,
    Start,
    begin,
    gain,
    shifted,
)
from mjx_climb.control.load_transfer import LoadTransfer
from mjx_climb.control.phased import phased
from mjx_climb.control.planned_transfer import PlannedTransfer
from mjx_climb.control.virtual_mass import Motion
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Scenario

# (controller, reading of the paper's equation), as a config names them
LAWS: dict[tuple[str, str], type[Law]] = {
    ("pd", "virtual_model"): PD,
    ("pd", "measured_pose"): PD,
    ("base_admittance", "virtual_model"): VirtualModelAdmittance,
    ("base_admittance", "measured_pose"): MeasuredPoseAdmittance,
    ("end_effector_admittance", "virtual_model"): EndEffectorAdmittance,
}

__all__ = [
    "LAWS", "PD", "SHIPPED", "Command", "EndEffectorAdmittance", "JointGains", "Law", "LoadTransfer",
    "MeasuredPoseAdmittance", "Measurement", "PlannedTransfer", "Reference", "Start", "VirtualModelAdmittance",
    "begin", "combined", "gain", "is_shipped", "law_of", "phased", "shifted", "shipped",
]  # fmt: skip


def _of_folder() -> dict[str, type[Law]]:
    """Return the laws of this folder by their names, without those that are made of others."""
    modules = [importlib.import_module(f"{__name__}.{found.name}") for found in pkgutil.iter_modules(__path__)]
    found = {each for module in modules for each in vars(module).values() if inspect.isclass(each)}
    laws = {
        each for each in found if issubclass(each, Law) and not (inspect.isabstract(each) or isinstance(each, Made))
    }
    return {law.__name__: law for law in sorted(laws, key=lambda law: law.__name__)}


SHIPPED = _of_folder()


def is_shipped(name: str) -> bool:
    """Return whether a name is one that `shipped` knows, or would be but for the names of gains."""
    return all(part.split("@")[0] in SHIPPED for part in name.split("+"))


def shipped(name: str) -> Law:
    """Return a law by its name: that of a shipped class, `NAME@GAIN,GAIN` for gains by phase, `NAME+NAME` for a sum.

    Raises:
        ValueError: gains by phase that the law does not have.
    """

    def part(text: str) -> Law:
        kind, *gains = text.split("@")
        return functools.reduce(lambda law, names: phased(law, names.split(",")), gains, SHIPPED[kind]())

    return functools.reduce(combined, map(part, name.split("+")))


def law_of(scenario: Scenario) -> Law:
    """Return the law that a scenario names, with the gains of its control section.

    Raises:
        ConfigError: it names one of the user's own, which is given beside it.
    """
    if scenario.own is not None and scenario.own.law is not None:
        got = f"none: {scenario.own.law.name} is loaded by tuning.gains.own_section.taken(scenario)"
        raise ConfigError("scenario", "own.law", "the law beside the scenario", got)
    law, control = LAWS[scenario.control.controller, scenario.control.reading], scenario.control
    values = {name: getattr(control, name) for name in law.GAINS}
    # six values of a law of translations alone: the rotations are not its own
    own: dict[str, Any] = {n: v[: law.GAINS[n].size] if isinstance(v, tuple) else v for n, v in values.items()}
    if law not in (VirtualModelAdmittance, EndEffectorAdmittance):
        return law(**own)
    limits = (control.deadband, control.max_offset, control.max_velocity)
    pairs = (v if isinstance(v, tuple) else (math.inf if v is None else v,) * 2 for v in limits)
    return law(**own, motion=Motion(control.integration == "semi_implicit", *pairs))
