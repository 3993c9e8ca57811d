"""The fit of very many readings: one pass through them, and normal equations block by block."""
