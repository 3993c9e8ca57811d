"""The fit of very many readings: one walk through them, and normal equations that are kept block by block."""
