"""Gains on disk: files, tables, parameters for a robot's own controller."""
