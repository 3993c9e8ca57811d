"""Faults that nobody foresaw, in the threads that keep a device's line alive."""


def words(error: Exception) -> str:
    """Tell such a fault.

    Libraries of makers raise what they like, also for half a line of garbage; a thread that ended with it would leave
    its device dead without a word until the next start.
    """
    return f"fault in the program or in a library that it uses: {type(error).__name__}: {error}"
