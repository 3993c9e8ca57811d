"""A machine's first files: the shipped example, and those that `rtec init` writes from answers."""
