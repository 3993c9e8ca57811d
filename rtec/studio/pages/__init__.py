"""The pages: each is a file with one function `build(session)`."""
