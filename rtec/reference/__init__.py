"""Every key of every file that people write, read off the models that check them."""
