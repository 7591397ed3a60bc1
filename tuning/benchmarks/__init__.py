"""What `mjx-climb bench` measures: this program, and its peers built on MuJoCo and NumPy."""
