"""What a fast path says of a program that is not for it."""


class Unsupported(Exception):
    """A fast path does not know an operation of a program; in one line, which. The plain path does."""
