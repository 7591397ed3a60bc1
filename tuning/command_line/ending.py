"""How a command ends when it does not end well: what the user did wrong, or that she stopped it."""

import sys


class InputError(ValueError):
    """An argument or option that cannot be used; in one line: option, what was expected, what was got."""


class Interrupted(Exception):
    """Ctrl-C, and what was kept."""


def user_error(error: Exception) -> str | None:
    """Return one line for an error that is the user's to mend, None for one of ours."""
    if hasattr(error, "format_message"):  # usage, from typer
        context = getattr(error, "ctx", None)
        hint = f" (see {context.command_path} --help)" if context is not None else ""
        return " ".join(error.format_message().split()) + hint
    kinds = [InputError]
    if "mjx_climb" in sys.modules:
        from mjx_climb import ConfigError, RobotError
        from mjx_climb.dataset import OutputError

        kinds += [ConfigError, RobotError, OutputError]
    if "mjx_climb.rendering" in sys.modules:
        from mjx_climb.rendering import RenderingError

        kinds.append(RenderingError)
    return " ".join(str(error).split()) if isinstance(error, tuple(kinds)) else None
