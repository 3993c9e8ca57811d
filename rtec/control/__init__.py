"""Watching and controlling a running daemon: the socket, requests, status, figures (`docs/control.md`)."""
