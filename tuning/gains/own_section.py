"""The user's own: FILE.py:NAME of laws and metrics, and the section `own` of a config.yaml that names them all."""

import dataclasses
import inspect
import operator
import os
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, get_args

import jax
import numpy as np
from pydantic import BaseModel

import mjx_climb as mc
from mjx_climb.component import with_values
from mjx_climb.control import SHIPPED, is_shipped, shipped
from mjx_climb.execution.contents import Unidentifiable, identity, in_library
from mjx_climb.inputs.file_contents import digest
from mjx_climb.inputs.own_objects import RUN, class_of, load, reference_to
from mjx_climb.scenario.kinds import Controller, shipped_kinds
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Kind

THE_CONFIG = "the config's law"


def load_law(text: str) -> mc.Law:
    """Return a law by its name, see `shipped`, or by FILE.py:NAME of an instance, or of a class with defaults.

    Raises:
        ConfigError: as of `load`; no such name.
    """
    if is_shipped(text):
        try:
            return shipped(text)
        except ValueError as error:
            raise ConfigError("", "law", reason=str(error)) from None
    if ":" not in text:
        raise ConfigError("", "law", f"FILE.py:NAME, or one of {', '.join(SHIPPED)}", f"{text!r}")
    found, file, name = load(text, "law")
    if isinstance(found, type) and issubclass(found, mc.Law):
        try:
            found = found()
        except TypeError as error:
            raise ConfigError(file, "", f"{name} to have its methods and a default for every gain: {error}") from None
    if not isinstance(found, mc.Law):
        raise ConfigError(file, "", f"{name} to be a law that inherits from mjx_climb.Law", f"{found!r}")
    return found


def load_metrics(texts: Iterable[str]) -> mc.MetricTable:
    """Return the shipped metrics with some of the user's own behind them, each FILE.py:NAME; errors as of `load`."""
    table = mc.METRICS
    for text in texts:
        found, file, name = load(text, "metric")
        if not isinstance(found, mc.Metric):
            raise ConfigError(file, "", f"{name} to be a metric, as of mjx_climb.Metric", f"{found!r}")
        try:
            table = mc.MetricTable((*table, found))
        except ValueError as error:
            raise ConfigError(file, name, reason=str(error)) from None
    return table


def reference(law: mc.Law) -> str:
    """Return FILE.py:NAME of a law's class, without the folder, as it stands in files.

    It is NAME alone of a shipped law, and where there is no file.
    """
    kind = type(law)
    if SHIPPED.get(kind.__name__) is kind:
        return kind.__name__
    # by its methods: a class of a file that was run by hand is in no module that Python knows
    codes = [function.__code__ for function in vars(kind).values() if inspect.isfunction(function)]
    files = [code.co_filename for code in codes if code.co_filename not in ("<string>", dataclasses.__file__)]
    return f"{Path(files[0]).name}:{kind.__qualname__}" if files else kind.__qualname__


def limits_of(law: mc.Law) -> dict[str, float]:
    """Return the fields of a law that are plain numbers and none of its gains: a walk is compiled for them."""
    others = [field.name for field in dataclasses.fields(law) if field.name not in law.GAINS]
    values = {name: getattr(law, name) for name in others}
    return {name: float(v) for name, v in values.items() if isinstance(v, (int, float)) and not isinstance(v, bool)}


def with_limits(law: mc.Law, limits: Mapping[str, float]) -> mc.Law:
    """Return a law with some of its `limits_of` replaced, as it is where it has them already."""
    changes = {name: value for name, value in limits.items() if value != getattr(law, name)}
    return dataclasses.replace(law, **changes) if changes else law


def check_reference(law: mc.Law | None, stored: str | None, source: str) -> None:
    """Raise ConfigError where something was stored for another law."""
    own = None if law is None else reference(law)
    if own is None and stored in get_args(Controller):
        raise ConfigError(source, "law", "no such key in gains of the config's own controller", stored)
    if own != stored:
        raise ConfigError(source, "law", f"gains of {own or THE_CONFIG}", f"those of {stored or THE_CONFIG}")


def section(
    law: mc.Law | None, metrics: Iterable[mc.Metric] = (), objective: Any = None, method: Any = None
) -> dict[str, Any] | None:
    """Return the section of config.yaml that names the user's own objects, None without any."""
    found: dict[str, Any] = {}
    if law is not None:
        gains = {name: np.asarray(getattr(law, name), float).tolist() for name in law.GAINS}
        found["law"] = _named(law, type(law).__qualname__) | ({"gains": gains} if gains else {})
        if is_shipped(name := reference(law)):  # by name alone it would have its own
            before = limits_of(load_law(name))
            if changed := {key: value for key, value in limits_of(law).items() if value != before.get(key)}:
                found["law"]["limits"] = changed
    if own := [_named(metric, metric.name) for metric in metrics if metric not in mc.METRICS]:
        found["metrics"] = own
    # a method that is a bare function is wrapped
    for key, own in (("objective", objective), ("method", getattr(method, "function", method))):
        if own is not None:
            found[key] = _named(own, getattr(own, "__name__", type(own).__name__))
    return found or None


def taken(
    scenario: mc.Scenario, law: mc.Law | None = None, metrics: mc.MetricTable = mc.METRICS, source: str = "scenario"
) -> tuple[mc.Scenario, mc.Law | None, mc.MetricTable]:
    """Return a scenario without the section, and law (None: the scenario's) and metrics: those that it names.

    `law`, and `metrics` other than the shipped ones, take the place of those that it names. The files named are run.

    Raises:
        ConfigError: in one line, a file that is gone or has changed, or that holds no such thing.
    """
    own = scenario.own
    if own is None:
        return scenario, law, metrics
    if law is None and own.law is not None:
        by_name = own.law.file is None and is_shipped(own.law.name)
        law = load_law(own.law.name if by_name else reference_to(own.law, "own.law", source))
        try:
            law = of_one(law, dict(own.law.gains.items()))
            if unknown := [key for key, _ in own.law.limits.items() if key not in limits_of(law)]:
                raise ValueError(f"limits.{unknown[0]}: expected one of {', '.join(limits_of(law)) or 'none'}")
            law = with_limits(law, dict(own.law.limits.items()))
        except (TypeError, ValueError) as error:
            raise ConfigError(source, "own.law", reason=str(error)) from None
    if metrics == mc.METRICS:
        metrics = load_metrics(reference_to(each, f"own.metrics.{n}", source) for n, each in enumerate(own.metrics))
    return without(scenario), law, metrics


def of_one(law: mc.Law, values: Mapping[str, Any]) -> mc.Law:
    """Return a law with some gains of one robot replaced, all of full length; TypeError, ValueError: no such values."""
    changed = with_values(law, values)
    for name in values:
        if (shape := np.shape(getattr(changed, name)))[: len(shape) - law.AXES[name]]:
            raise ValueError(f"expected the gains of one law, got {shape[0]} of {name}")
    return changed


def without(scenario: mc.Scenario) -> mc.Scenario:
    """Return a scenario that names no law and metrics; the rest stays: components, and an objective of its caller."""
    return scenario if scenario.own is None else scenario.with_own(law=None, metrics=[])


def _named(value: Any, name: str) -> dict[str, Any]:
    """Return file, name and digest of an object that a module of the user's holds; else its name alone."""
    for module, of_files in [*reversed(RUN), *((module, None) for module in list(sys.modules.values()))]:
        file, title = getattr(module, "__file__", None), getattr(module, "__name__", "__main__")
        if file is None or not file.endswith(".py") or title == "__main__":  # which would do all its work again
            continue
        if of_files is None and in_library(title):
            continue
        for key, found in list(vars(module).items()):
            if found is value or (_makes if isinstance(value, mc.Law) else _is_class_of)(found, value):
                return {"file": file, "name": key, "digest": of_files or digest(Path(file))}
    return {"name": name}


def _is_class_of(found: Any, value: Any) -> bool:
    """Return whether a class without arguments makes an object that is like another in all that it holds."""
    try:
        return isinstance(found, type) and found is type(value) and identity(found()) == identity(value)
    except (TypeError, Unidentifiable):
        return False


def _makes(found: Any, law: mc.Law) -> bool:
    """Return whether a class without arguments, or an instance, is a law but for its gains."""
    if found is type(law):
        try:
            found = found()
        except TypeError:  # a gain without a default
            return False
    return type(found) is type(law) and bool(operator.eq(*map(jax.tree.structure, (found, law))))


def named_by(text: str, place: str, option: str, before: BaseModel | None = None) -> dict[str, Any]:
    """Return the section of a shipped kind, or of FILE.py:NAME, which is run; `option` is where it was typed.

    A class takes the values that it has too from the section `before`.

    Raises:
        ConfigError: in one line, neither of them.
    """
    known = shipped_kinds(place)
    file, colon, name = text.rpartition(":")
    if text not in known and not (colon and file and name):
        raise ConfigError("", option, f"FILE.py:NAME, or one of {', '.join(known)}", f"{text!r}")
    section: dict[str, Any] = {"kind": text}
    if text not in known:
        section = {"kind": f"{os.path.abspath(file)}:{name}", "digest": digest(Path(file))}
    found = class_of(Kind(**section), place, option)
    kept = before.model_dump(mode="json") if before is not None and isinstance(found, type) else {}
    return section | {key: kept[key] for key in getattr(found, "VALUES", ()) if key in kept}
