"""The worth of gains that were found: rivals, fresh walks, margins, limits of stability, verdicts."""
