"""Choice of footholds: which of the points that can be held a limb swings to next."""
