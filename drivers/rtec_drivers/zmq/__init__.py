"""Another process as a device, by ZeroMQ (`docs/zmq-link.md`)."""
