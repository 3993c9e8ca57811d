"""Every key of every file that people write, derived from the models that check them."""
