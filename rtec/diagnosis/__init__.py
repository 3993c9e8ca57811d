"""Where a model fails, which effect is missing, and what the error becomes once it is added."""
