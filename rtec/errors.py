"""Every error that rtec raises on purpose.

    RtecError
    ├── ConfigError            a machine, run or device file has a value that is not allowed
    ├── DriverError
    │   ├── DriverUnavailable  the port, device or library does not exist here
    │   ├── DriverTimeout      the device exists but did not answer in time
    │   └── DriverFault        it answered, and the answer is wrong
    ├── ModelError             a model file or an effect is at fault, or does not fit the machine
    ├── MeasurementError       a measurement file is at fault
    └── LogError               a log or capture cannot be read

A message names the file, the section, the key or row, the value and what is allowed. The command line
prints it alone, without a traceback, and exits with status 2.
"""

from rtec.text import clean, clean_lines


class RtecError(Exception):
    """Base of all errors that a user can mend; its text, without unprintable characters, is shown unchanged."""

    def __init__(self, *content: object) -> None:
        super().__init__(*(clean_lines(part) if isinstance(part, str) else part for part in content))


class ConfigError(RtecError):
    """A machine, run or device file has a value that is not allowed."""


class DriverError(RtecError):
    """A device could not carry out a request."""


class DriverUnavailable(DriverError):
    """The port, the device or its library does not exist here."""


class DriverTimeout(DriverError):
    """The device did not answer in time."""


class DriverFault(DriverError):
    """The device answered, and the answer is wrong."""


class ModelError(RtecError):
    """A model file or an effect is at fault, or does not fit the machine."""


class MeasurementError(RtecError):
    """A measurement file is at fault."""


class LogError(RtecError):
    """A log or a logic-analyser capture cannot be read."""


def unforeseen(error: Exception) -> str:
    """Describe an unforeseen fault, where the program must go on or end in order all the same.

    Makers' libraries may raise anything, even for half a line of garbage.
    """
    return clean(f"fault in the program or in a library that it uses: {type(error).__name__}: {error}")


def first_line(error: BaseException) -> str:
    """First line of a library's message, without its details; the name of the error's class where it has none."""
    return (str(error).splitlines() or [type(error).__name__])[0]
