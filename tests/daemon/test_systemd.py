"""The files of the service, as `make install` puts them. Oracles: the checks of systemd; other files of the project."""

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

from rtec.control.server import MOST_CONNECTIONS, TELEMETRY_USER
from rtec.loop.run_file import load_setup

ROOT = Path(__file__).parents[2]
UNIT = "usr/lib/systemd/system/rtec@.service"
MOST_EXPOSED = 3.0
needs_make = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed (Debian package systemd)"
)


def make(target: str, dest: Path, umask: int = -1) -> None:
    command = ["make", "-C", str(ROOT), target, f"DESTDIR={dest}", "PREFIX=/usr"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, umask=umask)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Everything but the virtual environment, which takes the network; in its place a program that does nothing."""
    dest = tmp_path_factory.mktemp("dest")
    make("install-files", dest)
    for program in ("usr/bin/rtec", "bin/kill"):
        (dest / program).parent.mkdir(parents=True, exist_ok=True)
        (dest / program).write_text("#!/bin/sh\n")
        (dest / program).chmod(0o755)
    return dest


def directives(text: str) -> dict[str, list[str]]:
    """Every setting of a unit with all its values."""
    out: dict[str, list[str]] = {}
    for line in text.splitlines():
        if "=" in line and not line.startswith("#"):
            key, _, value = line.partition("=")
            out.setdefault(key, []).append(value)
    return out


@pytest.fixture(scope="module")
def unit(installed: Path) -> dict[str, list[str]]:
    return directives((installed / UNIT).read_text())


@needs_make
@needs_systemd
@pytest.mark.parametrize("name", ["rtec", "rtec-telemetry"])
def test_systemd_finds_nothing_wrong(installed: Path, tmp_path: Path, name: str) -> None:
    """`systemd-analyze verify`, of an instance; only units that every system has are missing here."""
    instance = tmp_path / f"{name}@mill.service"
    text = (installed / UNIT).with_name(f"{name}@.service").read_text().replace("/usr/bin/rtec", "/bin/true")
    instance.write_text(text)
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(instance)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    mine = [line for line in done.stderr.splitlines() if "rtec" in line]
    assert (done.returncode, mine) == (0, []), done.stderr


@needs_make
@needs_systemd
def test_systemd_calls_it_well_shut(installed: Path) -> None:
    """`systemd-analyze security`: 0 is shut, 10 is open."""
    done = subprocess.run(
        ["systemd-analyze", "security", "--offline=yes", "--no-pager", str(installed / UNIT)],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    found = re.search(r"Overall exposure level.*: ([0-9.]+)", done.stdout)
    if found is None:
        pytest.skip(f"this systemd-analyze cannot look at a file: {done.stderr.strip()}")
    assert float(found[1]) <= MOST_EXPOSED, done.stdout


@needs_make
def test_the_unit_says_what_the_daemon_does(unit: dict[str, list[str]]) -> None:
    """Oracles: `rtec.daemon.process` (ready, life), `state_files` (folders), `supervisor` (signals, status 130)."""
    assert unit["Type"] == ["notify"]
    assert unit["NotifyAccess"] == ["main"]
    assert int(unit["WatchdogSec"][0]) >= 6  # the ring holds the rows of six seconds of a supervisor that stands still
    assert unit["KillMode"] == ["mixed"]
    assert int(unit["LimitNOFILE"][0]) > 2 * MOST_CONNECTIONS
    assert {"MemoryMax", "TasksMax"} <= set(unit)
    assert unit["SuccessExitStatus"] == ["130"]
    assert unit["Restart"] == ["always"]
    assert unit["ExecReload"] == ["/bin/kill -HUP $MAINPID"]
    assert unit["ExecStart"] == ["/usr/bin/rtec run /etc/rtec/%i.toml"]
    assert unit["RuntimeDirectoryPreserve"] == ["yes"]  # the ledger outlives a kill in there
    folders = [unit[f"{name}Directory"][0] for name in ("Runtime", "State", "Logs")]
    assert folders == ["rtec/%i"] * 3


@needs_make
def test_what_publishes_has_the_network_and_no_device(installed: Path) -> None:
    """Oracle: what `rtec telemetry` does: it asks a local socket, speaks TCP, ends with 130."""
    unit = directives((installed / UNIT).with_name("rtec-telemetry@.service").read_text())
    assert unit["ExecStart"] == ["/usr/bin/rtec telemetry /etc/rtec/%i.toml"]
    assert unit["RestrictAddressFamilies"] == ["AF_UNIX AF_INET AF_INET6"]
    assert unit["DevicePolicy"] == ["closed"]
    assert unit["User"] == [TELEMETRY_USER]  # whom the daemon takes no order of
    assert "DeviceAllow" not in unit
    assert "LimitRTPRIO" not in unit
    assert unit["SuccessExitStatus"] == ["130"]
    assert unit["KillMode"] == ["mixed"]
    assert "RuntimeDirectory" not in unit  # the daemon's socket is there; this must not make or remove it


@needs_make
def test_real_time_is_allowed_and_nothing_else(unit: dict[str, list[str]]) -> None:
    """Oracles: the loop's priority in `[realtime]` is at most 98; serial ports are what drivers open."""
    assert unit["LimitRTPRIO"] == ["98"]
    assert unit["LimitMEMLOCK"] == ["infinity"]
    assert unit["CapabilityBoundingSet"] == [""]
    assert unit["NoNewPrivileges"] == ["yes"]
    assert unit["ProtectSystem"] == ["strict"]
    assert unit["PrivateNetwork"] == ["yes"]
    assert unit["RestrictAddressFamilies"] == ["AF_UNIX"]
    assert unit["DevicePolicy"] == ["closed"]
    assert all(re.fullmatch(r"char-tty\w+ rw", value) for value in unit["DeviceAllow"])
    assert "MemoryDenyWriteExecute" not in unit  # the kernels are compiled while it starts
    assert "ProcSubset" not in unit  # the computer's boot id stands in /proc/sys


@needs_make
def test_the_service_s_user_can_read_what_a_cautious_root_installs(tmp_path: Path) -> None:
    """`umask 077; make install`. Oracle: the modes of all that is there, also of folders that were there before."""
    dest = tmp_path / "dest"
    (dest / "etc/rtec").mkdir(parents=True)
    (dest / "etc/rtec").chmod(0o700)
    dest.chmod(0o755)
    make("install-files", dest, umask=0o077)
    found = {path: path.stat().st_mode & 0o777 for path in dest.rglob("*")}
    assert len(found) > 20
    shut = [str(path) for path, mode in found.items() if mode & 0o044 != 0o044 or (path.is_dir() and not mode & 1)]
    assert shut == []


@needs_make
def test_the_virtual_environment_is_made_under_the_same_mask(tmp_path: Path) -> None:
    """It takes the network; so a Python that only says what its mask is stands in for it."""
    python = tmp_path / "python"
    python.write_text(f"#!/bin/sh\numask >> {tmp_path}/masks\nexit 1\n")
    python.chmod(0o755)
    command = ["make", "-C", str(ROOT), "install-venv", f"DESTDIR={tmp_path}", "PREFIX=/usr", f"PYTHON={python}"]
    subprocess.run([*command, "ANY_PYTHON=1"], capture_output=True, timeout=120, check=False, umask=0o077)
    assert set((tmp_path / "masks").read_text().split()) == {"0022"}


@needs_make
def test_user_groups_and_ports_agree(installed: Path, unit: dict[str, list[str]]) -> None:
    """The unit's user is made, and is in the group that the udev rules give the ports to."""
    users = [line.split() for line in (installed / "usr/lib/sysusers.d/rtec.conf").read_text().splitlines()]
    made = {tuple(line[:2]) for line in users if line and line[0] in ("u", "g")}
    member = {tuple(line[1:3]) for line in users if line and line[0] == "m"}
    assert ("u", unit["User"][0]) in made
    rules = (installed / "etc/udev/rules.d/70-rtec.rules").read_text()
    groups = set(re.findall(r'GROUP="(\w+)"', rules))
    assert groups == {"dialout"}
    assert {(unit["User"][0], group) for group in groups} == member
    assert ("g", "dialout") in made


@needs_make
def test_udev_rules_are_well_formed(installed: Path) -> None:
    """Oracle: the grammar of udev(7): keys, operators, quoted values, separated by commas; every GOTO has its LABEL."""
    rules = (installed / "etc/udev/rules.d/70-rtec.rules").read_text()
    item = r'[A-Z]+(\{[A-Za-z_]+\})?\s*(==|!=|=|\+=|:=)\s*"[^"]*"'
    for line in rules.splitlines():
        if line and not line.startswith("#"):
            assert re.fullmatch(rf"{item}(, {item})*", line), line
    assert re.findall(r'GOTO="(\w+)"', rules) == re.findall(r'LABEL="(\w+)"', rules)
    assert 'SYMLINK+="rtec/$env{ID_SERIAL_SHORT}"' in rules


@needs_make
def test_the_network_drop_in_only_opens_what_the_unit_shuts(installed: Path, unit: dict[str, list[str]]) -> None:
    drop_in = directives((installed / "usr/share/doc/rtec/network.conf").read_text())
    assert drop_in["PrivateNetwork"] == ["no"]
    assert set(drop_in) == {"PrivateNetwork", "RestrictAddressFamilies", "IPAddressAllow"}
    assert unit["IPAddressDeny"] == ["any"]
    assert "any" not in drop_in["IPAddressAllow"]


@needs_make
def test_the_installed_example_runs_as_a_service(installed: Path) -> None:
    """Its files are all there, and its log goes where systemd says, since /etc cannot be written."""
    setup = load_setup(installed / "etc/rtec/turning-centre-sim.toml")
    assert setup.file.run.log_folder is None


def left_in(dest: Path) -> set[str]:
    """Every file and link, whether it leads somewhere or not."""
    return {str(p.relative_to(dest)) for p in dest.rglob("*") if p.is_symlink() or p.is_file()}


def pretend_environment(dest: Path) -> None:
    """What `install-venv` puts there; it would take the network."""
    (dest / "usr/lib/rtec/bin").mkdir(parents=True)
    (dest / "usr/lib/rtec/bin/rtec").write_text("#!/usr/lib/rtec/bin/python\n")
    (dest / "usr/bin").mkdir(parents=True, exist_ok=True)
    (dest / "usr/bin/rtec").symlink_to("/usr/lib/rtec/bin/rtec")
    (dest / "usr/share/bash-completion/completions").mkdir(parents=True, exist_ok=True)
    (dest / "usr/share/bash-completion/completions/rtec").write_text("# completion\n")


@needs_make
def test_what_a_user_changed_stays_and_uninstall_leaves_it_too(tmp_path: Path) -> None:
    """Also the second time, and where nothing is. Other programs' files beside them stay."""
    for _ in range(2):
        make("install-files", tmp_path)
        pretend_environment(tmp_path)
        mine = tmp_path / "etc/rtec/turning-centre-sim.toml"
        mine.write_text("# mine\n")
        (tmp_path / "usr/bin/other").write_text("# another program\n")
        make("install-files", tmp_path)
        assert mine.read_text() == "# mine\n"
        make("uninstall", tmp_path)
        left = left_in(tmp_path)
        assert {name for name in left if not name.startswith("etc/rtec/")} == {"usr/bin/other"}
        assert "etc/rtec/turning-centre-sim.toml" in left
        make("uninstall", tmp_path)
        assert left_in(tmp_path) == left


@needs_make
@pytest.mark.parametrize("target", ["install-files", "install-venv", "uninstall"])
@pytest.mark.parametrize(
    ("name", "value", "told"),
    [("DESTDIR", "{} b", "no spaces"), ("DESTDIR", "out", "whole paths"), ("PREFIX", "usr", "whole paths")],
)
def test_paths_that_would_hit_other_files_are_refused(
    tmp_path: Path, target: str, name: str, value: str, told: str
) -> None:
    """`rm -rf /tmp/a b/usr/lib/rtec` removes /tmp/a."""
    kept = tmp_path / "a" / "kept"
    kept.mkdir(parents=True)
    command = ["make", "-C", str(ROOT), target, f"DESTDIR={tmp_path}", f"{name}={value.format(kept.parent)}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2
    assert told in done.stdout
    assert kept.exists()


@needs_make
def test_a_slash_at_the_end_of_destdir_changes_nothing(tmp_path: Path) -> None:
    command = ["make", "-n", "-C", str(ROOT), "install", f"DESTDIR={tmp_path}/", "PREFIX=/usr"]
    with_slash = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    without = subprocess.run(
        [c.removesuffix("/") if c.startswith("DESTDIR") else c for c in command],
        capture_output=True, text=True, timeout=120, check=True,
    ).stdout  # fmt: skip
    assert with_slash == without
    assert f"{tmp_path}//" not in with_slash


def test_what_is_installed_is_what_is_tested() -> None:
    """Every version of requirements-run.lock is that of requirements.lock; every dependency of the package is in it."""
    pinned = [
        dict(re.findall(r"^([A-Za-z0-9_.\-]+)==([^\s;\\]+)", (ROOT / name).read_text(), re.MULTILINE))
        for name in ("requirements-run.lock", "requirements.lock")
    ]
    assert pinned[0].items() <= pinned[1].items()
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    assert {re.split("[><=]", name)[0] for name in wanted} <= set(pinned[0])
    assert "pytest" not in pinned[0]
