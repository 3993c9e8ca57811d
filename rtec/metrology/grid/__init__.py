"""Paths on a grid plate: set-ups, directions, speeds [XT]."""
