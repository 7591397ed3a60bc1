"""Robots: their constants, read from MJCF and URDF, and the postures of their limbs."""
