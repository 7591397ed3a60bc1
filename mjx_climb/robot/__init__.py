"""Robots: their constants, and the models that come with the program."""
