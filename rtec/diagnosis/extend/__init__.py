"""Adding effects to a model, one by one or until nothing significant is missing."""
