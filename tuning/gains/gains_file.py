"""Gains files: the result of a search as YAML: a law, its gains and limits, the joint loop's, the gait.

The gains are inertia, damping and stiffness, or those of another law as it names them. `law` says whose they are: the
name of a shipped law, or FILE.py:NAME; without it they are the config's law's. `kp`, `kd`, `ki`, `safe_kp` and the keys
of `gait` are the config's where they are not given.
"""

import inspect
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import mjx_climb as mc
from mjx_climb.component import in_full, with_values
from mjx_climb.control import LAWS, PD, SHIPPED, is_shipped, law_of
from mjx_climb.files.dataset import write_text_atomically
from mjx_climb.inputs.gait_values import GAIT, gait_of, own_gait, scenario_with_gait
from mjx_climb.inputs.resolve import AnyGains, with_gains
from mjx_climb.inputs.resolve import by_name as by_name
from mjx_climb.scenario import registers
from mjx_climb.scenario.declared import JOINT_GAINS
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Servo, overridden
from mjx_climb.scenario.yaml_text import parse, read
from tuning.gains import own_section
from tuning.gains.ros2_control import commented

REQUIRED = ("inertia", "damping", "stiffness")  # scalar or six values: translations x, y, z, then rotations
_EARLIER = "admittance.py"  # the file of Eqs. 2 and 3 in earlier versions, as some gains files name it
LAW = "law"  # whose gains they are: the name of a shipped law, or FILE.py:NAME; the config's where there is none
SECTION = "gait"
LIMITS = "limits"  # of a law: numbers beside its gains, for which a walk is compiled
_KEYS = [key.removeprefix("gait.") for key in GAIT]  # of the section


class Whole(NamedTuple):
    """The content of a gains file: gains, joint gains and gait, by name, and their law."""

    law: mc.Law | None  # the scenario's where None
    gains: AnyGains


def load(path: str | os.PathLike[str], law: mc.Law | None = None) -> AnyGains:
    """Read the gains of a file, the gait among them; `law` is the one whose gains are wanted, None for the scenario's.

    They are `mc.Gains` where they are the paper's without a gait, else a mapping. Where a file names another law than
    the scenario's, `walker` gives scenario and law that they are for.

    Raises:
        ConfigError: in one line, a fault of the file or a value, or the gains are those of another law.
    """
    source, data = os.fsdecode(path), _data(path)
    stored = data.pop(LAW, None)
    name = _shipped(stored)
    if not (of_scenarios(name) if law is None else own_section.reference(law) == name):
        own_section.check_reference(law, stored, source)
    required = REQUIRED if law is None and name != PD.__name__ else tuple((law or PD()).GAINS)
    gait, keys = _gait(data.pop(SECTION, {}), source), (*required, *JOINT_GAINS)
    _limits(data.pop(LIMITS, {}), PD() if law is None else law, source)
    for key in (*data, *required):
        if key not in keys:
            raise ConfigError(source, key, f"only the keys {', '.join(keys)}", "another")
        if key not in data:
            raise ConfigError(source, key, "a value", "none")
    # keys that the scenario has too are checked as there
    joint = data if law is None else {key: value for key, value in data.items() if key in JOINT_GAINS}
    try:
        control = overridden(mc.Scenario(), {f"control.{key}": value for key, value in joint.items()}, source).control
    except ConfigError as error:
        raise error.moved(key=error.key.removeprefix("control.")) from None
    values = {key: np.asarray(value, float) for key in joint if (value := getattr(control, key)) is not None}
    if law is None:
        return values | gait if gait or name == PD.__name__ else mc.Gains(**values)
    try:
        changed = with_values(law, {key: _array(data[key], key, source) for key in law.GAINS})
    except ConfigError:
        raise
    except (TypeError, ValueError) as error:
        raise ConfigError(source, reason=str(error).removeprefix("gains.")) from None
    return values | {key: getattr(changed, key) for key in law.GAINS} | gait


def _array(value: Any, key: str, source: str) -> np.ndarray:
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError):
        raise ConfigError(source, key, "a number, or lists of numbers of equal lengths", repr(value)[:40]) from None


def walker(
    path: str | os.PathLike[str], scenario: mc.Scenario, law: mc.Law | None = None
) -> tuple[mc.Scenario, mc.Law | None]:
    """Return scenario and law (None: the scenario's) with the law that a gains file names, unchanged if it names none.

    A law has the limits of the file, where it has some.

    Raises:
        ConfigError: the file cannot be read.
    """
    name = shipped_law(path)
    if name is None or name == own_section.reference(law or law_of(scenario)):
        return scenario, None if law is None else limited(path, law)
    if not of_scenarios(name):
        return scenario, limited(path, own_section.load_law(name))
    controller, reading = next(key for key, own in LAWS.items() if own.__name__ == name)
    return scenario.with_overrides({"control.controller": controller, "control.reading": reading}), None


def limited(path: str | os.PathLike[str], law: mc.Law) -> mc.Law:
    """Return a law with the limits of a gains file, as it is where the file is of another law, or says none.

    Raises:
        ConfigError: the file cannot be read, or a limit that the law does not have.
    """
    data = _data(path)
    if LIMITS not in data or own_section.reference(law) not in (data.get(LAW), _shipped(data.get(LAW))):
        return law
    return own_section.with_limits(law, _limits(data[LIMITS], law, os.fsdecode(path)))


def _limits(section: Any, law: mc.Law, source: str) -> dict[str, float]:
    """Return the limits of a file, checked."""
    known = own_section.limits_of(law)
    if not isinstance(section, dict):
        raise ConfigError(source, LIMITS, "a mapping of numbers", repr(section))
    for key, value in section.items():
        if key not in known:
            expected = f"only the keys {', '.join(known)}" if known else "none, as the law has no limits of its own"
            raise ConfigError(source, f"{LIMITS}.{key}", expected, "another")
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
            raise ConfigError(source, f"{LIMITS}.{key}", "a number above 0", repr(value))
    return {key: float(value) for key, value in section.items()}


def shipped_law(path: str | os.PathLike[str]) -> str | None:
    """Return the name of the shipped law that a gains file is of, None where it says no such law.

    Raises:
        ConfigError: the file cannot be read.
    """
    return _shipped(_data(path).get(LAW))


def whole(path: str | os.PathLike[str], scenario: mc.Scenario, law: mc.Law | None = None) -> Whole:
    """Read a gains file as it is to walk in a scenario: under its own law, where it names one, else under `law`.

    Raises:
        ConfigError: as of `load`; a gait that the scenario could not have.
    """
    place, own = walker(path, scenario, law)
    gains = load(path, own)
    with_gait(scenario, gains, os.fsdecode(path))
    return Whole(own if place is scenario else law_of(place), gains)


def _data(path: str | os.PathLike[str]) -> dict[str, Any]:
    source = os.fsdecode(path)
    data = parse(read(source), source)
    if not isinstance(data, dict):
        raise ConfigError(source, "", f"a mapping with keys {', '.join((*REQUIRED, *JOINT_GAINS))}")
    return data


def _shipped(stored: Any) -> str | None:
    """Return the name of the shipped law that a file names, alone or behind that of its module, None for another."""
    file, _, name = stored.rpartition(":") if isinstance(stored, str) else ("", "", "")
    module = Path(inspect.getfile(SHIPPED[name])).name if name in SHIPPED else ""
    return name if is_shipped(name) and file in ("", module, _EARLIER) else None


def of_scenarios(name: str | None) -> bool:
    """Return whether a law of this name is one that scenarios have."""
    return SHIPPED.get(name or "") in LAWS.values()


def _gait(section: Any, source: str) -> dict[str, np.ndarray]:
    """Return the values of a file's gait by their keys in a scenario."""
    if not isinstance(section, dict):
        raise ConfigError(source, SECTION, f"a mapping with keys {', '.join(_KEYS)}", repr(section))
    for key, value in section.items():
        if key not in _KEYS:
            raise ConfigError(source, f"{SECTION}.{key}", f"only the keys {', '.join(_KEYS)}", "another")
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ConfigError(source, f"{SECTION}.{key}", "a number", repr(value))
    return {f"{SECTION}.{key}": np.asarray(value, float) for key, value in section.items()}


def save(gains: AnyGains, path: str | os.PathLike[str], comment: str = "", law: mc.Law | None = None) -> Path:
    """Write a gains file, with `comment` on top, and return its path; `law` is the one that they belong to.

    Raises:
        OutputError: the file cannot be written.
    """
    return write_text_atomically(path, text(gains, comment, law))


def text(gains: AnyGains, comment: str = "", law: mc.Law | None = None) -> str:
    """Return the text of a gains file."""
    plain: dict[str, Any] = {} if law is None else {LAW: own_section.reference(law)}
    values = {key: np.asarray(value, float).tolist() for key, value in by_name(gains).items()}
    gait, left = gait_of(values), REQUIRED if isinstance(law, PD) else ()  # pd has none of these
    plain |= {key: value for key, value in values.items() if key not in gait and key not in left}
    if law is not None and type(law) not in LAWS.values() and (limits := own_section.limits_of(law)):
        plain[LIMITS] = limits
    plain |= {SECTION: {key.removeprefix("gait."): value for key, value in gait.items()}} if gait else {}
    return commented(comment, plain)


def with_gait(scenario: mc.Scenario, gains: AnyGains, source: str) -> mc.Scenario:
    """Return the scenario with the gait among gains; ConfigError with the source where it could not have it."""
    try:
        return scenario_with_gait(scenario, by_name(gains))
    except ConfigError as error:
        raise error.moved(source=source) from None


def completed(scenario: mc.Scenario, gains: AnyGains) -> AnyGains:
    """Return gains with all of the gait, where they have some of it, as it is walked in a scenario."""
    if not gait_of(values := by_name(gains)):
        return gains
    return values | own_gait(scenario_with_gait(scenario, values))


def apart(scenario: mc.Scenario, gains: AnyGains) -> tuple[mc.Scenario, AnyGains]:
    """Return the scenario with the gait among gains, and the gains without it."""
    values = by_name(gains)
    if not gait_of(values):
        return scenario, gains
    return scenario_with_gait(scenario, values), {key: value for key, value in values.items() if key not in GAIT}


def applied(scenario: mc.Scenario, gains: AnyGains) -> mc.Scenario:
    """Return the scenario with gains in its control section, their gait and values at paths, as far as it has them."""
    values = by_name(gains)
    control = {f"control.{name}": value for name, value in values.items() if name in REQUIRED + JOINT_GAINS}
    if "kp" in values and scenario.control.safe_kp is None:  # the scenario's own kp, not that of the gains
        control = {"control.safe_kp": scenario.control.kp} | control
    there = {name: value for name, value in values.items() if "." in name and name not in GAIT}
    return scenario_with_gait(scenario.with_overrides(control | there), values)


def replaced(scenario: mc.Scenario, law: mc.Law | None, gains: AnyGains) -> tuple[mc.Scenario, mc.Law | None]:
    """Return a scenario and a law of your own (None: the scenario's) with some gains in place of theirs."""
    values = by_name(gains)
    if law is None:
        return applied(scenario, values), None
    own = in_full(with_gains(law, {name: value for name, value in values.items() if "." not in name}))
    return applied(scenario, {name: value for name, value in values.items() if name not in law.GAINS}), own


def in_whole(scenario: mc.Scenario, law: mc.Law | None, gains: AnyGains) -> AnyGains:
    """Return some gains of a scenario, or of a law of your own, with all others that a file of theirs has."""
    values = by_name(gains)
    if law is None:
        missing = [name for name in REQUIRED if name not in values]
        return {name: getattr(scenario.control, name) for name in REQUIRED} | values if missing else gains
    own = in_full(with_gains(law, {name: value for name, value in values.items() if name in law.GAINS}))
    return values | {name: getattr(own, name) for name in law.GAINS}


def registers_in_words(scenario: mc.Scenario, gains: AnyGains) -> str:
    """Return the registers that hold gains of the joint loop, the scenario's where there are none, and their errors.

    Where the servo's scale is not known a line says so. Nothing where the scenario's servos are none whose loop gives a
    share of the voltage.
    """
    walked = applied(scenario, gains)
    servo, control = walked.hardware.servo, walked.control
    if (
        not isinstance(servo, Servo)
        or servo.torque_limit is None
        or (servo.drive == "torque" and scenario.value("hardware.servo.registers") is None)
    ):
        return ""
    wanted = registers.LoopGains(control.kp, control.ki, control.kd)
    if (scale := servo.register_scale) is None:
        own = ", ".join(f"{name} {value:g}" for name, value in wanted._asdict().items())
        return f"no registers for {own}: hardware.servo.register_scale does not say what a unit of them stands for"
    exact = registers.registers_of(wanted, scale, servo.torque_limit)
    most = scale.largest
    others = (None if value is None else min(round(value), most) for value in exact[1:])
    held = registers.Registers(min(round(exact.p), most), *others)
    found = registers.gains_of(held, scale, servo.torque_limit)
    words, off = [], []
    for register, value, (name, gain), reached in zip("PID", held, wanted._asdict().items(), found, strict=True):
        words.append(f"{register} Gain {'not known' if value is None and gain else value or 0}")
        if value is None and gain:
            off.append(f"{name} {gain:.3g}: the scale of {register} is not known")
        elif abs(reached - gain) > 0.02 * gain:
            off.append(f"{name} {reached:.3g} in place of {gain:.3g}")
    text = f"registers of the servo: Position {', '.join(words)}"
    return f"{text} ({', '.join(off)})" if off else text
