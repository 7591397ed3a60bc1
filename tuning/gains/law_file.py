"""Control laws in a user's file: FILE.py:NAME, a class whose gains have defaults, or an instance."""

import dataclasses
import inspect
from pathlib import Path

import mjx_climb as mc
from mjx_climb.scenario.messages import ConfigError
from tuning.problem import own_file

THE_CONFIG = "the config's law"


def load(text: str) -> mc.Law:
    """Return the law that FILE.py:NAME names; the file is run.

    Raises:
        ConfigError: in one line, no such file or name, a file that fails, or something else than a law.
    """
    found, file, name = own_file.load(text, "law")
    if isinstance(found, type) and issubclass(found, mc.Law):
        try:
            found = found()
        except TypeError as error:
            raise ConfigError(f"{file}: expected {name} to have a default for every gain: {error}") from None
    if not isinstance(found, mc.Law):
        raise ConfigError(f"{file}: expected {name} to be a law that inherits from mjx_climb.Law, got {found!r}")
    return found


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
