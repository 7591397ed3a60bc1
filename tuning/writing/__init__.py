"""The folder of a result: it appears whole or not at all."""
