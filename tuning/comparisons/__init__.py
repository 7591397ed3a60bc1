"""What found gains are worth: rivals, fresh walks, margins, limits of stability, verdicts."""
