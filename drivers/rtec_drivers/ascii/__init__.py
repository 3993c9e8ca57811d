"""Devices that print lines of text on a serial port."""
