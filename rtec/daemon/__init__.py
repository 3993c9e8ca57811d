"""The running daemon: supervisor, fast path, workers, and what they share."""
