"""A machine that does not exist: true errors of its own, sensors, a controller and servo drives."""
