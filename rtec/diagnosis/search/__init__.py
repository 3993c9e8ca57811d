"""Which physical effect a model is missing."""
