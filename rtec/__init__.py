"""rtec: real-time error correction for machine tools, and what its models still miss."""

__version__ = "0.1.0"
