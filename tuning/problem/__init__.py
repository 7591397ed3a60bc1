"""The search problem: settings, spaces of gains, objectives, ensembles, and the judging of points."""
