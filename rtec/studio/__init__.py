"""The browser: see where the model fails, add the effect that is missing, and watch the error fall.

Pages and nothing else: numbers come from the same functions as those of the command line, in a process of their own.
`docs/studio.md`.
"""
