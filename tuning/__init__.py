"""Searches for admittance gains, and the command line on top of them."""
