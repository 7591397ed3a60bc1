"""Pictures, films and recordings of walks."""
