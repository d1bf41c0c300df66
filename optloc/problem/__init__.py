"""One estimation problem and its answer as values."""
