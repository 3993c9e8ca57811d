"""The log of a run: written, rotated, packed, read, exported."""
