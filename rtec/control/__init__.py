"""Asking and controlling a running daemon: sockets, requests, keys, telemetry (`docs/control.md`)."""
