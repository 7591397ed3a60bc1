"""What `mjx-climb doctor` checks, and measures with `--bench`: this program, and peers built on MuJoCo and NumPy."""
