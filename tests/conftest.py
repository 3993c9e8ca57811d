"""What all tests share: hypothesis without a clock and with a fixed seed."""

from hypothesis import settings

settings.register_profile("rtec", deadline=None, derandomize=True)
settings.load_profile("rtec")
