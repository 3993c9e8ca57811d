"""Modbus modules, RTU and TCP (`docs/modbus.md`)."""
