"""Alarms as events, and lines that are said while nobody listens. Oracles: instants and flags written down by hand."""

import threading

from rtec.correction.flags import REASONS, Flag
from rtec.daemon.process import WAITING, LinePrinter
from rtec.daemon.status import MOST_REASONS, QUIET_NS, START_NS, Alarms
from rtec.loop.ports import HOLDS
from rtec.text import joined

S = 1_000_000_000
FIRST = 1 + START_NS


def alarms() -> tuple[Alarms, list[tuple[str, str]]]:
    told: list[tuple[str, str]] = []
    made = Alarms(lambda what, text: told.append((what, text)))
    made.look(1, Flag(0), {})
    return made, told


def test_beginning_and_end_are_told_once_with_how_long_it_lasted() -> None:
    """Stale for 3 s, with a good second in the middle: one alarm; over when ten seconds were good."""
    made, told = alarms()
    stale = REASONS[Flag.STALE_COUNTS]
    for at, flags in ((0, Flag.STALE_COUNTS | Flag.HELD), (1, Flag(0)), (3, Flag.STALE_COUNTS)):
        made.look(FIRST + at * S, flags, {})
    assert told == [("alarm", stale)]
    made.look(FIRST + 3 * S + QUIET_NS - 1, Flag(0), {})
    assert len(told) == 1
    made.look(FIRST + 3 * S + QUIET_NS, Flag(0), {})
    assert told[1:] == [("alarm over", f"{stale}; it lasted 3.0 s")]
    made.look(FIRST + 99 * S, Flag.STALE_COUNTS, {})
    assert told[2:] == [("alarm", stale)]


def test_an_alarm_of_a_flag_names_its_cause_once() -> None:
    """Oracle: `rtec.daemon.causes`. The age grows, the newest row may be good again; another sensor is news."""
    made, told = alarms()
    text, name = REASONS[Flag.SENSOR_FAULT], "SENSOR_FAULT"
    for k in range(3):
        made.look(FIRST + k * S, Flag.SENSOR_FAULT, {}, {name: f"sensor T_bed reads {1372 + k} °C"})
    made.look(FIRST + 3 * S, Flag.SENSOR_FAULT, {})
    assert told == [("alarm", f"{text}: sensor T_bed reads 1372 °C")]
    made.look(FIRST + 4 * S, Flag.SENSOR_FAULT, {}, {name: "sensor T_nut reads 1372 °C"})
    assert told[1:] == [("alarm", f"{text}: sensor T_nut reads 1372 °C")]


def test_a_reason_that_changes_with_time_is_one_alarm_and_every_device_has_its_own() -> None:
    made, told = alarms()
    for k in range(5):
        made.look(FIRST + k * S, Flag(0), {"box": [f"silent for {k} s"], "probe": ["no answer"]})
    assert told == [("alarm", "device box: silent for 0 s"), ("alarm", "device probe: no answer")]


def test_what_somebody_ordered_and_the_first_seconds_are_no_alarm() -> None:
    made, told = alarms()
    made.look(FIRST - 1, Flag.STALE_TEMPERATURE, {"probe": ["not read yet"]})
    made.look(FIRST, Flag.ORDERED_HOLD | Flag.ORDERED_OFF | Flag.FADING | Flag.LIMITED | Flag.HELD, {})
    assert told == []


def test_whoever_does_not_listen_keeps_nobody_waiting() -> None:
    """The first line is never taken; all others return at once, and at most so many of them wait."""
    go, said = threading.Event(), list[str]()

    def say(line: str) -> None:
        assert go.wait(60)
        said.append(line)

    with LinePrinter(say) as aloud:
        for k in range(10 * WAITING):
            aloud.line(str(k))
        go.set()
    assert said[:2] == ["0", "1"]
    assert WAITING <= len(said) <= WAITING + 1


def test_another_reason_of_one_device_is_told_once() -> None:
    """No answer for 3 s, then a value that no sensor has, and no answer again: two reasons, one alarm."""
    made, told = alarms()
    for k, text in enumerate(["no answer for 1 s", "no answer for 2 s", "T reads 3276.7", "no answer for 4 s"]):
        made.look(FIRST + k * S, Flag(0), {"thermo": [text]})
    assert told == [("alarm", "device thermo: no answer for 1 s"), ("alarm", "device thermo: T reads 3276.7")]
    made.look(FIRST + 3 * S + QUIET_NS, Flag(0), {})
    assert told[2:] == [
        ("alarm over", "device thermo: no answer for 1 s; then device thermo: T reads 3276.7; it lasted 3.0 s")
    ]


def test_reasons_without_end_are_no_flood() -> None:
    """A device that says something else each second. Oracle: the limit."""
    made, told = alarms()
    for k in range(20):
        made.look(FIRST + k * S, Flag(0), {"odd": ["x" * k]})
    assert len(told) == MOST_REASONS
    made.look(FIRST + 20 * S, Flag(0), {"odd": [f"it restarted; {HOLDS}"]})
    assert told[MOST_REASONS:] == [("alarm", f"device odd: it restarted; {HOLDS}")], "an order is waited for"


def test_a_loop_that_stands_is_an_alarm() -> None:
    """Once, though the time in its text grows; over when it goes on."""
    made, told = alarms()
    for k in range(5):
        made.look(FIRST + k * S, Flag(0), {}, loop=f"the loop stands: no cycle for {2 + k} s")
    made.look(FIRST + 4 * S + QUIET_NS, Flag(0), {})
    assert [kind for kind, _ in told] == ["alarm", "alarm over"]
    assert told[0][1] == "the loop stands: no cycle for 2 s"


def test_a_clause_of_two_reasons_is_said_once() -> None:
    assert joined(["lost; it holds", "far away; it holds (`resume`)"]) == "lost; far away; it holds (`resume`)"
    made, told = alarms()
    made.look(FIRST, Flag(0), {"box": ["lost; it holds", "far away; it holds"]})
    assert told == [("alarm", "device box: lost; it holds; far away")]
