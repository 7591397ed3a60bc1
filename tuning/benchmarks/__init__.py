"""What `mjx-climb doctor` checks, and measures with `--bench`: this program, and its peers built on MuJoCo and NumPy."""
