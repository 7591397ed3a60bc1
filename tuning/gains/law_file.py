"""Control laws in a user's file: FILE.py:NAME, a class whose gains have defaults, or an instance."""

import dataclasses
import importlib.util
import inspect
import sys
from pathlib import Path
from typing import Any

import mjx_climb as mc
from mjx_climb.scenario.messages import ConfigError

THE_CONFIG = "the config's law"


def load(text: str) -> mc.Law:
    """Return the law that FILE.py:NAME names; the file is run.

    Raises:
        ConfigError: in one line, no such file or name, a file that fails, or something else than a law.
    """
    file, colon, name = text.rpartition(":")
    if not (colon and file and name):
        raise ConfigError(f"law: expected FILE.py:NAME, got {text!r}")
    found = getattr(_run(Path(file)), name, None)
    if found is None:
        raise ConfigError(f"{file}: expected a law named {name}, got none")
    if isinstance(found, type) and issubclass(found, mc.Law):
        try:
            found = found()
        except TypeError as error:
            raise ConfigError(f"{file}: expected {name} to have a default for every gain: {error}") from None
    if not isinstance(found, mc.Law):
        raise ConfigError(f"{file}: expected {name} to be a law that inherits from mjx_climb.Law, got {found!r}")
    return found


def _run(file: Path) -> Any:
    if not file.is_file():
        raise ConfigError(f"{file}: expected a file of Python, got none")
    spec = importlib.util.spec_from_file_location(file.stem, file)
    if spec is None or spec.loader is None:
        raise ConfigError(f"{file}: expected a file of Python, whose name ends in .py")
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(file.absolute().parent))  # for what the file itself imports, as python FILE does
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else ""
        raise ConfigError(f"{file}: {type(error).__name__}: {reason}") from None
    finally:
        sys.path.pop(0)
    return module


def reference(law: mc.Law) -> str:
    """Return FILE.py:NAME of a law's class, without the folder, as it stands in files; NAME where it has no file."""
    kind = type(law)
    # by its methods: a class of a file that was run by hand is in no module that Python knows
    codes = [function.__code__ for function in vars(kind).values() if inspect.isfunction(function)]
    own = [code.co_filename for code in codes if code.co_filename not in ("<string>", dataclasses.__file__)]
    files = [Path(name).name for name in own]
    return f"{files[0]}:{kind.__qualname__}" if files else kind.__qualname__


def check_reference(law: mc.Law | None, stored: str | None, source: str) -> None:
    """Refuse what was stored for another law.

    Raises:
        ConfigError: in one line, for which law it was.
    """
    own = None if law is None else reference(law)
    if own != stored:
        raise ConfigError(f"{source}: law: expected gains of {own or THE_CONFIG}, got those of {stored or THE_CONFIG}")
