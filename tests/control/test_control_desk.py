"""What the daemon answers to any message, without a socket.

Oracles: the orders that the daemon was given; the answers as `docs/control.md` has them, read by `json` alone.
"""

import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtec.control.desk import REPORT_NS, SESSION_NS, Desk, Peer
from rtec.control.messages import LARGEST_REQUEST, RequestError, read_request
from rtec.loop.clock import VirtualClock
from rtec.loop.orders import Order
from rtec.loop.run_file import Setup
from tests.support import setups
from tests.support.control_rig import FakeDaemon

NS = 10**9


@pytest.fixture(scope="module")
def setup(tmp_path_factory: pytest.TempPathFactory) -> Setup:
    return setups.setup(tmp_path_factory.mktemp("run"))


@pytest.fixture
def daemon(setup: Setup) -> FakeDaemon:
    return FakeDaemon(setup)


def test_a_session_ends_by_itself(daemon: FakeDaemon) -> None:
    """An order that was held up on its way for longer than a session lasts is old."""
    clock = VirtualClock(NS)
    desk, peer = Desk(daemon, clock, {}), Peer("cell", "operate")

    def give(seq: int, wait_ns: int) -> dict[str, Any]:
        session = json.loads(desk.answer(b'{"schema":1,"ask":"session"}', peer))["session"]
        clock.sleep_until_ns(clock.now_ns() + wait_ns)
        order = {"schema": 1, "ask": "order", "session": session, "seq": seq, "order": "fade"}
        found: dict[str, Any] = json.loads(desk.answer(json.dumps(order).encode(), peer))
        return found

    assert "done" in give(0, SESSION_NS)
    assert "is over" in give(1, SESSION_NS + 1)["refused"]
    assert len(daemon.orders) == 1


def test_refusals_take_no_more_room_however_many_come(daemon: FakeDaemon) -> None:
    """Told once a minute, with the number of those kept back."""
    clock = VirtualClock(NS)
    desk = Desk(daemon, clock, {})
    for _ in range(700):
        desk.answer(b"?", Peer("cell", "operate"))
    assert daemon.notes == ["cell: is no JSON text"]
    clock.sleep_until_ns(NS + REPORT_NS)
    desk.answer(b"?", Peer("cell", "operate"))
    assert daemon.notes[1:] == ["cell: is no JSON text (and 699 more since the last entry)"]


def test_a_name_is_taken_once(daemon: FakeDaemon) -> None:
    """Else it would grow with every request."""
    desk, peer = Desk(daemon, VirtualClock(NS), {}), Peer("root", "operate")
    ask = b'{"schema":1,"ask":"as","name":"cell","role":"operate"}'
    assert json.loads(desk.answer(ask, peer))["name"] == "cell (root)"
    for _ in range(100):
        assert "cannot take another name" in json.loads(desk.answer(ask, peer))["refused"]
    assert (peer.name, peer.role) == ("cell (root)", "operate")


@pytest.mark.parametrize(
    ("message", "says"),
    [
        (b"", "is no JSON text"),
        (b"\xff", "is no JSON text"),
        (b"[" * 4000, "is no JSON text"),
        (b"[]", "is no JSON object"),
        (b"{}", "'schema' must be 1"),
        (b'{"schema":true,"ask":"status"}', "'schema' must be 1"),
        (b'{"schema":2,"ask":"status"}', "'schema' must be 1"),
        (b'{"schema":1}', "'ask' must be one of status, watch, as, session, order"),
        (b'{"schema":1,"ask":["status"]}', "'ask' must be"),
        (b'{"schema":1,"ask":"status","order":"hold"}', "unknown key 'order'"),
        (b'{"schema":1,"ask":"status","id":1.0}', "'id' must be an integer"),
        (b'{"schema":1,"ask":"order"}', "'session' must be"),
        (b'{"schema":1,"ask":"as","name":"cell","role":"root"}', "'role' must be 'read' or 'operate'"),
        (b'{"schema":1,"ask":"status","x":"' + b"a" * LARGEST_REQUEST + b'"}', "longer than 4096 bytes"),
    ],
)
def test_what_is_wrong_with_a_message_is_told(message: bytes, says: str) -> None:
    with pytest.raises(RequestError, match=says):
        read_request(message)


@pytest.mark.parametrize("text", ["\x1b[2J", "a\nb", "\\ud800", "\u2028", "x" * 401])
def test_texts_that_do_things_to_terminals_and_files_are_refused(text: str) -> None:
    raw = text if text.startswith("\\") else json.dumps(text)[1:-1]
    head = '{"schema":1,"ask":"order","session":"' + "0" * 32 + '","seq":1,"order":"mark","text":"'
    with pytest.raises(RequestError, match="printable"):
        read_request(f'{head}{raw}"}}'.encode())


_json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)
_likely = st.fixed_dictionaries(
    {},
    optional={
        "schema": st.just(1) | _json,
        "ask": st.sampled_from(["status", "watch", "as", "session", "order"]) | _json,
        "id": st.integers(0, 9) | _json,
        "session": st.just("0" * 32) | _json,
        "seq": st.integers(0, 9) | _json,
        "order": st.sampled_from([*Order]) | _json,
        "text": _json,
    },
)
_messages = (
    st.binary(max_size=60) | _json.map(lambda v: json.dumps(v).encode()) | _likely.map(lambda v: json.dumps(v).encode())
)


@settings(max_examples=200)
@given(message=_messages)
def test_no_message_gets_an_order_through_without_a_session(setup: Setup, message: bytes) -> None:
    """Nor makes the desk raise; every answer is an object of the schema, and what is noted fits into a file."""
    daemon = FakeDaemon(setup)
    found = json.loads(Desk(daemon, VirtualClock(NS), {}).answer(message, Peer("cell", "operate")))
    assert found["schema"] == 1
    assert daemon.orders == []
    "".join(daemon.notes).encode()
