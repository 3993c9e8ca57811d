"""A machine's first files: the shipped example, and the files that `rtec init` writes from answers."""
