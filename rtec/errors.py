"""Every error that rtec raises on purpose.

    RtecError
    ├── ConfigError            a machine, run or device file says something that cannot be
    ├── DriverError
    │   ├── DriverUnavailable  the port, device or library is not there
    │   ├── DriverTimeout      it is there and did not answer in time
    │   └── DriverFault        it answered, and the answer is wrong
    ├── ModelError             a model file or an effect is wrong, or does not fit the machine
    ├── MeasurementError       a measurement file is wrong
    └── LogError               a log or capture cannot be read

A message names the file, the section, the key or row, what was found and what is allowed. The command line
prints it alone, without a traceback, and exits with status 2.
"""

from rtec.text import clean, clean_lines


class RtecError(Exception):
    """Base of all errors that a user can mend; its text, cleaned of what is not printable, is shown as it is."""

    def __init__(self, *content: object) -> None:
        super().__init__(*(clean_lines(part) if isinstance(part, str) else part for part in content))


class ConfigError(RtecError):
    """A machine, run or device file says something that cannot be."""


class DriverError(RtecError):
    """A device could not do what was asked."""


class DriverUnavailable(DriverError):
    """The port, the device or the library that speaks to it is not there."""


class DriverTimeout(DriverError):
    """The device did not answer in time."""


class DriverFault(DriverError):
    """The device answered, and the answer is wrong."""


class ModelError(RtecError):
    """A model file or an effect is wrong, or does not fit the machine."""


class MeasurementError(RtecError):
    """A measurement file is wrong."""


class LogError(RtecError):
    """A log or a logic-analyser capture cannot be read."""


def unforeseen(error: Exception) -> str:
    """Tell a fault that nobody foresaw, where something must go on or end in order all the same.

    Libraries of makers raise what they like, also for half a line of garbage.
    """
    return clean(f"fault in the program or in a library that it uses: {type(error).__name__}: {error}")
