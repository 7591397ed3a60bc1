"""The hardware between control law and joints: sensors, control period, bus and servos."""
