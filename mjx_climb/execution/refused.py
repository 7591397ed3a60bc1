"""The one error that is the user's to mend."""


class Refused(ValueError):
    """A request that cannot be carried out; in one line: what, what was expected, what was got."""
