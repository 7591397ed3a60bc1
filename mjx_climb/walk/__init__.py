"""One step of a walk, in the layout of the hot path: gait, contact, control, disturbance, samples and metrics."""
