"""What the pages are made of: the session of a tab, the actions on it, controls, plots."""
