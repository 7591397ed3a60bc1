"""Robots from URDF and MJCF files: read, checked, put into a rest stance."""
