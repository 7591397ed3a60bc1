"""Load transfer for a robot: gains as YAML and as C++, and the law in one C++ header, which lies beside this file."""

import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml

import mjx_climb as mc
from mjx_climb.control import LoadTransfer

LAW = Path(__file__).with_suffix(".hpp")  # in C++
Parameters = dict[str, tuple[float, str, str]]  # value, unit and meaning by name
_BOUNDS = {
    "max_offset": ("m", "distance of a standing foot from its reference, at most"),
    "max_rate": ("m/s", "speed of a standing foot, at most"),
    "torque_limit": ("N m", "torque of a servo from where on its foot is not moved further out; infinite: never"),
}
_SAFE_KP = "N m/rad", "kp of all joints at least, once a force sensor is lost"
_HEADER = """\
Gains of load transfer, written by mjx-climb export for the law in load_transfer.hpp, which says what goes in and out.
{found}
- Call the law every {period:g} s and hold its targets in between. At another period, or with later forces, walk anew.
- Forces are those of the ground on the feet, in world axes, zeroed in the air. With the wrong sign the offsets grow.
- The times until lift-off and since touchdown are those of the gait that the robot is going to walk.
- pull_limit is soft: feet that cannot bear the wrench otherwise pull harder. Keep it well below what grippers hold.
- max_offset and max_rate bound the targets of standing feet. Whether a limb can reach its target is yours to check.
- A sensor that reads exactly 0, or no number, for 0.1 s counts as dead (sensor_lost says so). Then no foot gives way,
  and safe_kp() says what kp should be: soft joints may not hold without the law. One that is stuck or biased is not
  noticed: give 0 in its place.
- Begin with offsets of zero, in the air; then one foot, then all feet, standing; then walk."""
_CPP = """\
{comment}
#pragma once

#include <limits>

#include "{law}"

namespace mjx_climb {{

inline constexpr LoadTransferGains load_transfer_gains = [] {{
  LoadTransferGains gains;
{lines}  return gains;
}}();

}}  // namespace mjx_climb
"""


def parameters(law: LoadTransfer, period: float, safe_kp: float) -> Parameters:
    """Return the parameters of the law in C++, with its period in s and the joint loop's gain without a sensor."""
    gains = {name: (float(getattr(law, name)), field.unit, field.long_name) for name, field in law.GAINS.items()}
    bounds = {name: (float(getattr(law, name)), *words) for name, words in _BOUNDS.items()}
    more = {"period": (float(period), "s", "from one step of the law to the next")}
    return more | gains | bounds | {"safe_kp": (float(safe_kp), *_SAFE_KP)}


def texts(
    law: LoadTransfer, period: float, walked: mc.Scenario | None = None, given: Mapping[str, Any] = MappingProxyType({})
) -> dict[str, str]:
    """Return the files for a robot, by their names: gains as YAML, gains as C++, and the law.

    Arguments:
        period: from one step of the law to the next, s.
        walked: where the gains were walked, with their joint gains and gait; None where they were not.
        given: joint gains and gait that go with them, by name, where they were not walked.
    """
    names = {"yaml": "load_transfer.yaml", "cpp": "load_transfer_gains.hpp"}
    found = "They come from simulation, nobody said of which hardware, and were not walked before they were written."
    if walked is not None:
        found = (
            f"They come from simulation, and were walked with the joint gains, gait and hardware in {names['yaml']}."
        )
    own = float(mc.parameters(mc.Scenario() if walked is None else walked).joint_loop.safe_kp)
    safe_kp = given.get("safe_kp", own) if walked is None else own
    header, values = _HEADER.format(found=found, period=period), parameters(law, period, safe_kp)
    return {
        names["yaml"]: _comment("#", header) + _yaml(values) + (_given(given) if walked is None else _walked(walked)),
        names["cpp"]: _cpp(header, values),
        LAW.name: LAW.read_text(encoding="utf-8"),
    }


def _comment(mark: str, text: str) -> str:
    return "".join(f"{mark} {line}\n" for line in text.splitlines())


def _yaml(values: Parameters) -> str:
    # one value at a time: YAML's floats are not Python's, and each has its comment
    lines = [f"  {yaml.safe_dump({n: v}).strip()}  # {unit}, {text}\n" for n, (v, unit, text) in values.items()]
    return "".join(["load_transfer:\n", *lines])


def _given(values: Mapping[str, Any]) -> str:
    return yaml.safe_dump({"given": {n: float(v) for n, v in values.items()}}, sort_keys=False) if values else ""


def _walked(scenario: mc.Scenario) -> str:
    control = scenario.control
    sections = {name: getattr(scenario, name).model_dump(mode="json") for name in ("gait", "hardware")}
    tree = {"walked": {"kp": control.kp, "kd": control.kd} | sections}
    return yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=110)


def _cpp(header: str, values: Parameters) -> str:
    infinite = "std::numeric_limits<double>::infinity()"
    numbers = {name: infinite if math.isinf(value) else repr(value) for name, (value, *_) in values.items()}
    lines = "".join(f"  gains.{name} = {numbers[name]};  // {unit}\n" for name, (_, unit, _) in values.items())
    return _CPP.format(comment=_comment("//", header), law=LAW.name, lines=lines)
