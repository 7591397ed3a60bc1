"""Checks of `mjx-climb doctor`, and its measurements: this program, and peers built on MuJoCo and NumPy."""
