"""Robots from URDF and MJCF files: read, checked, proposed, put into a rest stance."""
