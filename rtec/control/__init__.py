"""Looking at a running daemon and giving it orders: the socket, requests, status, figures (`docs/control.md`)."""
