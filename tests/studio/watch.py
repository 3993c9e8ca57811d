"""A page Live beside a daemon, for so many seconds: `nice -n 19 python -m tests.studio.watch CONFIG SECONDS`.

Says "open" when the page is, waits for the daemon, and says at the end what state the page shows.
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.studio.studio_rig import chromium, running_studio, tab


def main(config: Path, seconds: float) -> None:
    """Look at it."""
    with (
        TemporaryDirectory() as folder,
        running_studio(Path(folder), "--attach", str(config)) as studio,
        chromium() as browser,
    ):
        page = tab(browser, studio.address).page
        sys.stdout.write("open\n")
        sys.stdout.flush()
        page.locator(".state.on, .state.held").wait_for()
        page.wait_for_timeout(1e3 * seconds)
        sys.stdout.write(page.locator(".state").inner_text() + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), float(sys.argv[2]))
