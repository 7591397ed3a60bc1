"""The report of a command, one HTML page that needs no network, and the pictures and tables that stand on it."""
