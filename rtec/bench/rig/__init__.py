"""Simulated machines, thermal networks and instruments, independent of the judged program."""
