"""Replays logs and captures through the same step as a run."""
