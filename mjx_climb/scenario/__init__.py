"""What walks where, under which controller and disturbance: a validated YAML file."""
