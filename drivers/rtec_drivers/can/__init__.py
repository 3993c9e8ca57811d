"""Devices on a CAN bus (`docs/can.md`)."""
