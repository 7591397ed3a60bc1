"""What stands between a control law and the joints of a real robot: sensors, rate, bus and servos, a stage a file."""
