"""What a fast path of compilation cannot do: raised while tracing, so that the caller goes by the plain path."""

from typing import Any


class Unsupported(NotImplementedError):
    """An operation, or a use of it, that a fast path does not know."""

    equation: Any = None  # which one, where that is known


def refuse_unknown(name: str, parameters: dict[str, Any], understood: frozenset[str]) -> None:
    """Raise `Unsupported` where an operation has parameters that nobody has thought of; those left empty are fine."""
    for parameter, value in parameters.items():
        if parameter not in understood and value is not None and value is not False and value != ():
            raise Unsupported(f"the operation {name} with {parameter}={value}")
