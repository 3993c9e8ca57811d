"""Laws that hold for every example, each as one test: a test of a millisecond costs more than what it does."""

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any

Law = Callable[..., None]


def law_for(examples: Sequence[object]) -> Callable[[Law], Law]:
    """Decorator of a test with the argument `example`: it goes through all; the one that breaks it is named below."""

    def each(law: Law) -> Law:
        @functools.wraps(law)
        def test(**fixtures: Any) -> None:
            for example in examples:
                try:
                    law(example=example, **fixtures)
                except BaseException as e:
                    e.add_note(f"example: {example}")
                    raise

        given = inspect.signature(law)
        own = [p for name, p in given.parameters.items() if name != "example"]
        test.__signature__ = given.replace(parameters=own)  # type: ignore[attr-defined]
        return test

    return each
