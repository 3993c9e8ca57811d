"""Checks whether the devices work, and whether this computer is fit for real time."""
