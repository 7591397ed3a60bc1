"""What holds a foot to the ground, and when it lets go (paper Eq. 5)."""
