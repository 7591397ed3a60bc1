"""Objects in a user's file, as options name them: FILE.py:NAME."""

import importlib.util
import os
import sys
import types
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mjx_climb as mc
from mjx_climb.files import scenario_files
from mjx_climb.scenario.messages import ConfigError

RUN: list[tuple[types.ModuleType, str]] = []  # what was run here, and the digest of its files then


def load(text: str, what: str) -> tuple[Any, str, str]:
    """Return the object that FILE.py:NAME names, and both names; the file is run.

    Raises:
        ConfigError: in one line, no such file or name, or a file that fails; `what` was wanted, as "law".
    """
    file, colon, name = text.rpartition(":")
    if not (colon and file and name):
        raise ConfigError(f"{what}: expected FILE.py:NAME, got {text!r}")
    found = getattr(_run(Path(file)), name, None)
    if found is None:
        raise ConfigError(f"{file}: expected a {what} named {name}, got none")
    return found, file, name


def metrics(texts: Iterable[str]) -> mc.MetricTable:
    """Return the shipped metrics with some of the user's own behind them, each FILE.py:NAME.

    Raises:
        ConfigError: in one line, no such metric, or one whose name is taken.
    """
    table = mc.METRICS
    for text in texts:
        found, file, name = load(text, "metric")
        if not isinstance(found, mc.Metric):
            raise ConfigError(f"{file}: expected {name} to be a metric, as of mjx_climb.Metric, got {found!r}")
        try:
            table = mc.MetricTable((*table, found))
        except ValueError as error:
            raise ConfigError(f"{file}: {name}: {error}") from None
    return table


def _run(file: Path) -> Any:
    if not os.path.isfile(file):  # where it may not be read either
        raise ConfigError(f"{file}: expected a file of Python, got none")
    spec = importlib.util.spec_from_file_location(file.stem, file)
    if spec is None or spec.loader is None:
        raise ConfigError(f"{file}: expected a file of Python, whose name ends in .py")
    module = importlib.util.module_from_spec(spec)
    digest = scenario_files.digest(file)
    sys.path.insert(0, str(file.absolute().parent))  # for what the file itself imports, as python FILE does
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else ""
        raise ConfigError(f"{file}: {type(error).__name__}: {reason}") from None
    finally:
        sys.path.pop(0)
    RUN.append((module, digest))
    return module
