"""The searches, their methods, what they keep on disk and what they return."""
