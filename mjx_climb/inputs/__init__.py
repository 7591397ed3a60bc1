"""Gains and parameters of a walk, computed from a scenario and checked."""
