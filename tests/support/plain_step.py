"""Steps as plain Python, for tests of many structures in a few cycles each: to compile one takes two seconds.

That the compiled step gives the same numbers is judged in tests/loop/test_step.py and test_channels_loop.py.
"""

from collections.abc import Sequence
from types import ModuleType

import pytest

from rtec import jit

PLAIN_NJIT = "def njit(f=None, **options):\n    return f or (lambda g: g)\n"


def plain_module(text: str, depends_on: Sequence[ModuleType] = ()) -> ModuleType:
    """Give what `build_module` gives, nothing compiled."""
    del depends_on
    module = ModuleType("plain_step")
    exec(f"import math\n{PLAIN_NJIT}\n{text}", module.__dict__)  # noqa: S102 - our own text
    for name, value in list(vars(module).items()):
        setattr(module, name, jit.as_written(value))
    return module


def use(monkeypatch: pytest.MonkeyPatch) -> None:
    """From now on every step is plain."""
    monkeypatch.setattr("rtec.loop.step.build_module", plain_module)
