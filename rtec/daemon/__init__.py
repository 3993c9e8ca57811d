"""The running daemon: supervisor, fast path, workers, and their shared memory."""
