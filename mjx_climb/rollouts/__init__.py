"""Whole walks: one robot with its histories, batches with their metrics and tangents."""
