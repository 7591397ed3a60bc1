"""What stands between a control law and the joints of a real robot: sensors, control period, bus and servos."""
