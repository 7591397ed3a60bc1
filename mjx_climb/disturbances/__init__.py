"""What acts on the robot from outside."""
