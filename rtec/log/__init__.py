"""The log of a run: writing, rotating, packing, reading, exporting."""
