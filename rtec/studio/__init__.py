"""The browser: shows where the model fails, adds the missing effect, and shows the error fall.

`pages` has a file for each page, `parts` what they are made of, `server` what sends them. Nothing is computed here:
numbers come from `rtec.tasks`, and so from the same functions as on the command line. `docs/studio.md`.
"""
