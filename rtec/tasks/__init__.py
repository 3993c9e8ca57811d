"""What a front end needs and does not draw: the opened folder, tasks in a process of their own, a daemon to follow.

The studio is one; nothing here knows how it shows the results.
"""
