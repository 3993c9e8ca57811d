"""How wrong a model is, against the noise floor, and where."""
