"""`diagnose` and `improve` on the same files, at the price of one: `improve` begins with that very diagnosis."""

from collections.abc import Sequence
from typing import Any
from unittest import mock

from rtec.diagnosis.extend import improve as module
from rtec.diagnosis.extend.improve import Improved, improve
from rtec.diagnosis.result import Diagnosis
from rtec.diagnosis.search.changes import with_changes
from rtec.diagnosis.search.diagnose import diagnose
from rtec.metrology.measurement import Measurement
from rtec.model import Model


def both(model: Model, files: Sequence[Measurement], changes: bool = False, **more: Any) -> tuple[Diagnosis, Improved]:
    """What `diagnose` says of a model, with the numbers that have changed if wanted, and what `improve` makes of it.

    `tests/diagnosis/test_both.py` holds the first against a diagnosis of its own.
    """
    made: list[tuple[Model, Diagnosis, Any]] = []

    def noted(asked: Model, *given: Any, **how: Any) -> Diagnosis:
        found = diagnose(asked, *given, **how)
        made.append((asked, found, how["given"]))
        return found

    with mock.patch.object(module, "diagnose", noted):
        done = improve(model, files, **more)
    asked, found, given = made[0]
    assert asked is model
    return (with_changes(found, model, given) if changes else found), done
