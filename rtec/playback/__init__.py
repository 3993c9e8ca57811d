"""Logs and captures through the same step."""
