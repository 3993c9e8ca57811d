"""The browser: shows where the model fails, adds the missing effect, and shows the error fall.

This package has pages only: numbers come from the same functions as on the command line, in a process of their own.
`docs/studio.md`.
"""
