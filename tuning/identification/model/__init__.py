"""Models of a robot's log: held, gripped, or walked again."""
