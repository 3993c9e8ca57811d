"""Alarms as events, and lines that are said while nobody listens. Oracles: instants and flags written down by hand."""

import threading

from rtec.correction.flags import REASONS, Flag
from rtec.daemon.process import WAITING, LinePrinter
from rtec.daemon.status import MORE, MOST_REASONS, QUIET_NS, RECENT_NS, START_NS, Alarms
from rtec.loop.ports import HOLDS
from rtec.text import gist, joined, without_numbers

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
    assert told[MOST_REASONS:] == [("alarm", f"device odd: {MORE}")], "once"
    del told[:]
    made.look(FIRST + 20 * S, Flag(0), {"odd": [f"it restarted; {HOLDS}"]})
    assert told == [("alarm", f"device odd: it restarted; {HOLDS}")], "an order is waited for"
    del told[:]
    for k in range(21, 21 + RECENT_NS // S):
        made.look(FIRST + k * S, Flag(0), {"odd": ["y" * k]})
    assert 0 < len(told) <= MOST_REASONS + 1, "ten minutes later there is room again"


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


def test_what_an_order_to_resume_ended_is_news_when_it_comes_again() -> None:
    """Lost, resumed, and lost again 4 s later: two alarms. What is there before and after the order is one."""
    made, told = alarms()
    lost, silent = f"READY came: it restarted; {HOLDS}", "no answer for 1 s"
    made.look(FIRST, Flag(0), {"cell": [lost, silent], "thermo": [silent]}, takeovers=3)
    made.look(FIRST + 1 * S, Flag(0), {"cell": [silent], "thermo": [silent]}, takeovers=4)
    made.look(FIRST + 5 * S, Flag(0), {"cell": [lost, silent], "thermo": [silent]}, takeovers=4)
    first = f"device cell: {lost}; {silent}"
    assert told == [("alarm", first), ("alarm", f"device thermo: {silent}"), ("alarm", first)]
    del told[:]
    made.look(FIRST + 6 * S, Flag(0), {"thermo": [silent]}, takeovers=5)
    assert told == [("alarm over", f"{first}; it lasted 5.0 s")]


def test_a_reason_that_stays_hides_no_other() -> None:
    """Nobody resets a CANopen emergency, and lines of garbage come. A later bus-off is an event, each time."""
    made, told = alarms()
    emergency, off = "node 5: emergency message, error code 8110h", "can0: bus-off: look at wiring"
    for k in range(3):
        made.look(FIRST + k * S, Flag(0), {"can": [emergency, f"a line that fits no pattern: {'x; y' * k!r}"]})
    assert len(told) == 1
    for at in (20, 60):
        for k in range(20):
            made.look(FIRST + (at + k) * S, Flag(0), {"can": [emergency, *([off] if k == 10 else [])]})
    assert told[1:] == [("alarm", f"device can: {emergency}; {off}")] * 2


def test_numbers_that_are_names_differ() -> None:
    """Oracle: sensors, nodes and error codes that a person tells apart; ages, which nobody does."""
    names = ["T1: open circuit", "T2: open circuit", "node 5: x", "node 6: x", "code 8110h", "code 8120h", "code FF10h"]
    assert len({without_numbers(name) for name in names}) == len(names)
    for one, other in (("for 1.5 s", "for 12 s"), ("is -3e-05 off", "is +12 off"), ("seq=7", "seq=812")):
        assert without_numbers(one) == without_numbers(other)
    assert gist("""T1: 'a; b\\'c' is no number; the device's own "x"; it's 3 s old""") == [
        "T1:  is no number", "the device's own ", "it's  s old",
    ]  # fmt: skip
    made, told = alarms()
    for k, name in enumerate(("T1", "T2")):
        made.look(FIRST + k * S, Flag(0), {"thermo": [f"{name}: open circuit"]})
    assert len(told) == 2
