"""What a log would have recorded of a robot: held, gripped, or walked again."""
