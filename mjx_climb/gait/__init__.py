"""What the robot is asked to do: the schedule of its limbs, their swings, the path of its base."""
