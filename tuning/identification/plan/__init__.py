"""Motions to record a log of, and the information of such logs."""
