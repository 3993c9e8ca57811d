"""What a tab keeps when files go away under it. Oracle: the steps that were made before."""

from pathlib import Path
from typing import Any

import pytest

import rtec
from rtec.model import Model, save_model
from rtec.studio.parts.session import ModelStep, TabSession
from rtec.tasks import foreign
from rtec.tasks.folder import Folder, Summary
from rtec.tasks.jobs import Job
from tests.studio.studio_rig import MACHINE
from tests.tasks.test_model import Silent


@pytest.fixture
def session(tmp_path: Path) -> TabSession:
    """A machine, a model that was read, and one step added to it."""
    (tmp_path / "machine.toml").write_bytes(MACHINE.read_bytes())
    model = Model(rtec.load_machine(tmp_path / "machine.toml"), ())
    save_model(model, tmp_path / "model.toml")
    made = TabSession(Folder(tmp_path))
    made.look()
    made.steps = (ModelStep(model, "as it is"),)
    return made


def test_a_model_that_is_deleted_takes_no_unsaved_addition_with_it(session: TabSession) -> None:
    """Another model in the folder does not take its place either."""
    session.push(ModelStep(session.steps[0].model, "backlash", ("add",)))
    path = session.folder.root / "model.toml"
    path.rename(path.with_name("other.toml"))
    session.look()
    assert (session.model, len(session.steps), session.at) == ("model.toml", 2, 1)


def test_a_model_that_is_deleted_before_anything_was_added_is_no_longer_chosen(session: TabSession) -> None:
    """The only other one is."""
    path = session.folder.root / "model.toml"
    path.rename(path.with_name("other.toml"))
    session.look()
    assert (session.model, session.steps) == ("other.toml", ())


def test_an_addition_is_put_aside_when_other_files_are_chosen_and_can_be_brought_back(session: TabSession) -> None:
    """Oracle: machine, model, measurements and steps of before. What is brought back puts aside what is there then."""
    session.chosen = ("a.csv", "b.csv")
    session.push(ModelStep(session.steps[0].model, "backlash", ("add",)))
    before: Any = (session.machine, session.model, session.chosen, session.steps, session.at)
    session.choose(chosen=("a.csv",))
    assert [a.words for a in session.aside] == ["backlash"]
    assert session.step is None
    session.choose(chosen=())  # nothing was added meanwhile
    assert len(session.aside) == 1
    session.steps = before[3][:1]
    session.push(ModelStep(before[3][0].model, "scale", ("add",)))
    session.bring_back()
    assert (session.machine, session.model, session.chosen, session.steps, session.at) == before
    assert [a.words for a in session.aside] == ["scale"]


def test_an_addition_that_is_saved_or_undone_is_not_put_aside(session: TabSession) -> None:
    """It is in its file, or was not wanted."""
    session.push(ModelStep(session.steps[0].model, "backlash", ("add",)))
    session.saved = {1: "better.toml"}
    session.choose(chosen=("a.csv",))
    session.steps, session.at = (ModelStep(Model(rtec.load_machine(MACHINE), ()), "as it is"),), 0
    session.choose(model="")
    assert session.aside == ()


def _changed(session: TabSession) -> None:
    """The model's file, by another program."""
    path = session.folder.root / "model.toml"
    path.write_bytes(path.read_bytes() + b"\n")


def _state(session: TabSession) -> tuple[tuple[str, ...], int]:
    """Names of the changed files, and the number of steps."""
    return session.outdated, len(session.steps)


def test_a_file_that_changed_is_forgotten_only_if_nothing_was_added(session: TabSession) -> None:
    """Nor while work goes on that may use it. What was brought back is as old as it was."""
    session.read = session.stamps()
    assert _state(session) == ((), 1)
    session.job = Job("Comparing", lambda: None)
    _changed(session)
    session.look_at_chosen()
    assert _state(session) == (("model.toml",), 1)
    session.job = None
    session.push(ModelStep(session.steps[0].model, "backlash", ("add",)))
    session.look()
    assert _state(session) == (("model.toml",), 2)
    session.choose()
    assert _state(session) == ((), 0)
    session.bring_back()
    assert _state(session) == (("model.toml",), 2)
    session.steps, session.at = session.steps[:1], 0
    session.look()
    assert _state(session) == ((), 0)


def test_a_measurement_that_changed_is_listed_anew(session: TabSession) -> None:
    """Its TOML counts too. Oracle: which summaries are kept."""
    root = session.folder.root
    for name in ("a", "b", "c"):
        (root / f"{name}.csv").write_text("time_s\n1\n")
        (root / f"{name}.toml").write_text('[measurement]\ninstrument = "laser_linear"\n')
    session.look()
    session.summaries = {n: Summary(n) for n in session.listing.measurements}
    (root / "b.csv").write_text("time_s\n1\n2\n")
    (root / "c.toml").write_text('[measurement]\ninstrument = "laser_linear"\naxis = "X"\n')
    session.look()
    assert list(session.summaries) == ["a.csv"]


def test_of_a_long_table_some_readings_are_previewed(tmp_path: Path) -> None:
    """Oracle: the rows of the table, which all count; what the page draws of them is little."""
    lines = [f"{k};{20 * (k % 8)};{1 - 2 * (k // 8 % 2)};{k % 3},5;20,0" for k in range(30_000)]
    head = "Zeit [s];X Soll [mm];Richtung;Abweichung [um];T_x_nut [degC]"
    (tmp_path / "long.csv").write_text("\n".join([head, *lines]) + "\n", encoding="utf-8")
    view = foreign.look_at_foreign(Silent(), tmp_path / "long.csv", MACHINE, {}, None)
    assert (view.trouble, view.rows) == ("", 30_000)
    assert foreign.PREVIEWED <= len(view.place) < 2 * foreign.PREVIEWED


def test_a_log_of_temperatures_in_the_folder_comes_with_the_readings(tmp_path: Path) -> None:
    """Oracle: the log's constant temperature, in every reading; the command that does the same."""
    head = "Zeit;X Soll [mm];Richtung;Abweichung [um]"
    lines = [f"08:{k // 60:02d}:{k % 60:02d};{20 * (k % 8)};{1 - 2 * (k // 8 % 2)};{k % 3},5" for k in range(600)]
    (tmp_path / "laser.csv").write_text("\n".join([head, *lines]) + "\n", encoding="utf-8")
    log = "".join(f"08:{k:02d}:00;23,5\n" for k in range(12))
    (tmp_path / "log file.csv").write_text(f"Zeit;T_x_nut [degC]\n{log}", encoding="utf-8")
    view = foreign.look_at_foreign(Silent(), tmp_path / "laser.csv", MACHINE, {}, None, "log file.csv")
    assert (view.trouble, view.rows) == ("", 600)
    assert any("log file.csv" in note for note in view.notes)
    assert foreign.import_foreign(Silent(), tmp_path / "laser.csv", view.proposal, tmp_path / "made.csv")
    made = rtec.load_measurement(tmp_path / "made.csv", MACHINE)
    assert set(made.channels["T_x_nut"]) == {23.5}


@pytest.mark.parametrize(("content", "said"), [(b"", "no lines"), (b"\n\n", "no lines"), (b"\xff\xfe\x00", "table")])
def test_an_empty_file_says_so(content: bytes, said: str, tmp_path: Path) -> None:
    """In a sentence that names the file."""
    (tmp_path / "e.csv").write_bytes(content)
    with pytest.raises(rtec.RtecError, match=f"e.csv: .*{said}"):
        foreign.look_at_foreign(Silent(), tmp_path / "e.csv", MACHINE, {}, None)
