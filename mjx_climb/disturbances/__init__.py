"""Disturbances: wrenches and masses from outside."""
