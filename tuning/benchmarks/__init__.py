"""What `mjx-climb doctor --bench` measures: this program, and its peers built on MuJoCo and NumPy."""
