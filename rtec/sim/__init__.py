"""A simulated machine: true errors, sensors, a controller and servo drives."""
