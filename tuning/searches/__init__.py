"""The searches: grids, gains of a law, fronts, schedules; and shards of them for several machines."""
