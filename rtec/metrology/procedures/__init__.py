"""Procedures of the guidelines [G 3]: pure functions from readings to figures, each with its limits."""
