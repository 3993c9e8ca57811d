"""Seeded measurements by any instrument on a machine whose true effects are chosen."""
