"""One fused function of the state, generated from the effects of a model."""
