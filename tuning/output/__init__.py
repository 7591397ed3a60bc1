"""What a result leaves in a folder, files, pictures and report: the same from Python and at the shell."""
