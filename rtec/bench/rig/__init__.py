"""Simulated machines, thermal networks and instruments that know nothing of the program that is judged by them."""
