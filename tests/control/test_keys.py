"""Key files and the list of clients.

Oracles: libzmq, which says which public key belongs to a secret one; the permissions that the file system says.
"""

import os
import stat
import tomllib
from pathlib import Path

import pytest
import zmq

from rtec.control.keys import AllowList, add_client, make_server, read_client, read_clients, read_server, remove_client
from rtec.errors import ConfigError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    make_server(tmp_path / "keys")
    return tmp_path / "keys"


def test_pairs_are_pairs_and_each_side_knows_the_other(folder: Path, tmp_path: Path) -> None:
    out = add_client(folder, "cell", "operate", None, tmp_path / "cell.key")
    assert out is not None
    server, client = read_server(folder), read_client(out)
    for pair in (server, client):
        assert zmq.curve_public(pair.secret.encode()).decode() == pair.public
    assert client.server == server.public
    assert {n: (c.key, c.role) for n, c in read_clients(folder / "clients.toml").items()} == {
        "cell": (client.public, "operate")
    }


def test_nobody_else_reads_the_secrets(folder: Path, tmp_path: Path) -> None:
    """Whatever the umask allows; and the secret of a client stays in its own file."""
    before = os.umask(0)
    try:
        made = add_client(folder, "cell", "read", None, tmp_path / "cell.key")
    finally:
        os.umask(before)
    assert made is not None
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    for path in (made, folder / "server.key", folder / "clients.toml"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    secret = tomllib.loads(made.read_text(encoding="utf-8"))["secret"]
    assert not [p for p in folder.iterdir() if secret in p.read_text(encoding="utf-8")]


def test_a_key_that_others_may_read_is_not_used(folder: Path) -> None:
    (folder / "server.key").chmod(0o640)
    with pytest.raises(ConfigError, match="others may read this secret; `chmod 600"):
        read_server(folder)


def test_a_changed_key_is_told(folder: Path) -> None:
    """Another secret of good form, which libzmq would take without a word."""
    _, other = zmq.curve_keypair()
    pair = read_server(folder)
    path = folder / "server.key"
    path.write_text(path.read_text(encoding="utf-8").replace(pair.secret, other.decode()), encoding="utf-8")
    with pytest.raises(ConfigError, match="the two keys are not a pair"):
        read_server(folder)


def test_a_client_that_made_its_own_pair_hands_over_its_public_key_alone(folder: Path, tmp_path: Path) -> None:
    public, _ = zmq.curve_keypair()
    assert add_client(folder, "office", "read", public.decode(), tmp_path / "office.key") is None
    assert not (tmp_path / "office.key").exists()
    assert AllowList(folder / "clients.toml").find(public.decode()) == ("office", "read")
    with pytest.raises(ConfigError, match="on the list under another name"):
        add_client(folder, "twice", "operate", public.decode(), tmp_path / "x.key")
    with pytest.raises(ConfigError, match="'abc' is no public key: 40 characters"):
        add_client(folder, "short", "read", "abc", tmp_path / "x.key")


@pytest.mark.parametrize("name", ["", "a b", "-a", "../a", "a\n", "ä", "a" * 41])
def test_names_that_are_none(folder: Path, tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="is no name for a client"):
        add_client(folder, name, "read", None, tmp_path / "x.key")


def test_nothing_is_written_over(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"server.key: is there already"):
        make_server(folder)
    (tmp_path / "cell.key").write_text("mine", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"cell.key: is there already; name another file with --out"):
        add_client(folder, "cell", "read", None, tmp_path / "cell.key")
    assert read_clients(folder / "clients.toml") == {}
    assert (tmp_path / "cell.key").read_text(encoding="utf-8") == "mine"
    add_client(folder, "cell", "read", None, tmp_path / "cell-2.key")
    with pytest.raises(ConfigError, match="cell is on the list"):
        add_client(folder, "cell", "operate", None, tmp_path / "cell-3.key")


def test_whoever_is_taken_off_is_off_and_a_typing_error_is_told(folder: Path, tmp_path: Path) -> None:
    made = add_client(folder, "office", "read", None, tmp_path / "office.key")
    assert made is not None
    key, allowed = read_client(made).public, AllowList(folder / "clients.toml")
    assert allowed.find(key) == ("office", "read")
    with pytest.raises(ConfigError, match="no client 'offic'; did you mean 'office'"):
        remove_client(folder, "offic")
    assert allowed.find(key) == ("office", "read")
    remove_client(folder, "office")
    assert allowed.find(key) is None


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[client", "not valid TOML"),
        ('[client.a]\nkey = "short"\nrole = "read"', "key"),
        (f'[client.a]\nkey = "{"a" * 40}"\nrole = "admin"', "role"),
        (
            f'[client.a]\nkey = "{"a" * 40}"\nrole = "read"\n[client.b]\nkey = "{"a" * 40}"\nrole = "operate"',
            "same key",
        ),
        (f'[client."a b"]\nkey = "{"a" * 40}"\nrole = "read"', "is no name for a client"),
    ],
)
def test_a_list_with_anything_wrong_lets_nobody_in_and_says_why(folder: Path, text: str, says: str) -> None:
    (folder / "clients.toml").write_text(text, encoding="utf-8")
    allowed = AllowList(folder / "clients.toml")
    assert allowed.find("a" * 40) is None
    assert "nobody is let in over the network" in allowed.trouble
    assert says in allowed.trouble


def test_missing_files_say_how_to_make_them(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="make them with `rtec keys server"):
        read_server(tmp_path)
    with pytest.raises(ConfigError, match="`rtec keys client` makes one"):
        read_client(tmp_path / "cell.key")
    with pytest.raises(ConfigError, match=r"clients.toml: no such file; `rtec keys server"):
        read_clients(tmp_path / "clients.toml")
