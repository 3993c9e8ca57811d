"""Drivers for rtec: one module per bus, named in `rtec_drivers.registry.DRIVERS`."""
