"""The one error that is the user's to mend."""


class Refused(ValueError):
    """A request that cannot be carried out. Its message is one line: the name, expected, got."""
