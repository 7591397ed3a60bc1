"""Motions to record a log of: what they tell, and how sure."""
