"""Scenarios: robot, ground, gait, controller and disturbances in a validated YAML file."""
