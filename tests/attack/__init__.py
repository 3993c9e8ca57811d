"""An attack from outside on everything that listens, reads or can be pulled out: `make attack`."""
