"""What is searched: settings, spaces of gains, objectives, ensembles, and the judging of points."""
