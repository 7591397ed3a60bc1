"""From a robot's own log to the parameters of its model: excite, identify, replay."""
