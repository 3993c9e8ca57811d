"""Measurement files: a table and the TOML beside it (`docs/measurements.md`)."""
