"""Is the time step short enough, and does this installation compute what it should?"""
