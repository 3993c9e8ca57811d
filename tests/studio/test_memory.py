"""What a page leaves behind. Oracle: Python's own list of the objects that are alive."""

import subprocess
import sys
from pathlib import Path

PROGRAM = """
import asyncio, gc, sys
from pathlib import Path

from fastapi.testclient import TestClient
from nicegui import Client

from rtec.studio.server.app import made


def alive():
    gc.collect()
    return sum(type(one) is Client for one in gc.get_objects())


async def tidied():
    Client.prune_instances(client_age_threshold=0)
    for _ in range(500):
        if not alive():
            break
        await asyncio.sleep(0.02)
    print(alive())


with TestClient(made(Path(sys.argv[1]), None, "read")) as browser:
    for _ in range(5):
        assert browser.get("/").status_code == 200
    browser.portal.call(tidied)
"""


def test_a_page_that_no_browser_keeps_open_stays_nowhere(tmp_path: Path) -> None:
    """Five requests without a websocket, as of a check that the studio is up: each page had stayed for ever."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path)], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["0"]
