"""Measurements with hidden effects: a world of its own that knows nothing of the program under test.

Pure numpy. Nothing here imports `rtec` (checked by import-linter): machine, lever arms, temperatures, instruments,
noise and true shapes are written down a second time, and the shapes on purpose not as the program's formulas have them.
"""
