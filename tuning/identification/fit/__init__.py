"""The fit of a robot's parameters to a log, and how sure it is."""
