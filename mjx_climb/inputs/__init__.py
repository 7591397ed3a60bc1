"""What a walk is given: gains and parameters, worked out from a scenario and checked."""
