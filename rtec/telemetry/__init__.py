"""Publishes the status of a running daemon in a shop's network: read-only processes, one a protocol."""
