"""Pictures of what clients show: the simulated machine, a daemon, `rtec telemetry`, a broker, Prometheus, and their
clients, all of this computer. `python -m tests.telemetry.pictures docs/figures`.

A terminal is drawn as text. Grafana is in no Debian package: its panels are drawn from what Prometheus itself answers
to the queries of `configs/grafana/rtec.json`.
"""

import asyncio
import json
import shutil
import socket
import subprocess
import sys
import tempfile
import textwrap
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from asyncua import Client
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from asyncua.crypto.uacrypto import CertProperties

from rtec.loop.clock import RealClock, wall_clock_ns
from tests.support.control_rig import free_place
from tests.support.telemetry_rig import certificates

CONFIGS = Path(__file__).parents[2] / "configs"
SHOWN_S = 60
WIDTH = 100
TABLES = """
[control]
prometheus = "{prometheus}"

[telemetry.mqtt]
broker = "localhost:{broker}"
tls = false
topic = "shop/lathe"

[telemetry.mtconnect]
listen = "{mtconnect}"

[telemetry.opcua]
listen = "{opcua}"
certificate_file = "mill.pem"
key_file = "mill.key"
trusted_folder = "trusted"
"""


@contextmanager
def started(*command: str) -> Iterator[None]:
    """A program that runs meanwhile."""
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        try:
            yield
        finally:
            process.terminate()


def wait(seconds: float) -> None:
    """Let the machine run."""
    clock = RealClock()
    clock.sleep_until_ns(clock.now_ns() + round(1e9 * seconds))


def terminal(path: Path, title: str, text: str) -> None:
    """Draw lines of text as a terminal shows them."""
    from matplotlib.figure import Figure

    lines = [part for line in text.splitlines() for part in _wrapped(line)]
    height = 0.21 * (len(lines) + 3)
    figure = Figure(figsize=(10.4, height), facecolor="#16181d")
    for k, line in enumerate((title, "", *lines)):
        color = "#8fb8ff" if k == 0 else "#e4e6eb"
        place = 1.0 - (0.21 * k + 0.1) / height
        figure.text(
            0.015, place, line, family="DejaVu Sans Mono", fontsize=9.5, va="top", color=color, parse_math=False
        )
    figure.savefig(path, dpi=110)


def _wrapped(line: str) -> list[str]:
    return textwrap.wrap(line, WIDTH, subsequent_indent="  ", break_on_hyphens=False) or [""]


def mqtt(port: str) -> str:
    """What mosquitto_sub prints of one state and one message of values."""
    command = ["mosquitto_sub", "-h", "localhost", "-p", port, "-t", "shop/#", "-F", "%t\n%p", "-C", "2", "-W", "60"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def mtconnect(place: str) -> str:
    """What an agent is sent first."""
    host, port = place.split(":")
    with socket.create_connection((host, int(port))) as agent:
        agent.sendall(b"* PING\n")
        wait(1.0)
        return "\n".join(agent.recv(65536).decode().splitlines()[:11])


def opcua(place: str, keys: Path) -> str:
    """The address space as asyncua's client browses it."""
    lines: list[str] = []

    async def below(node: Any, depth: int) -> None:
        for child in await node.get_children():
            name = await child.read_browse_name()
            if child.nodeid.NamespaceIndex == 0 or depth > 6 or name.Name == "EngineeringUnits":
                continue
            shown = ""
            if (await child.read_node_class()).name == "Variable":
                value = await child.read_data_value(raise_on_bad_status=False)
                units = [
                    c for c in await child.get_children() if (await c.read_browse_name()).Name == "EngineeringUnits"
                ]
                unit = (await units[0].read_value()).DisplayName.Text if units else ""
                good = value.Value.Value if value.Value else value.StatusCode.name
                shown = f"{good:.3f} {unit}" if isinstance(good, float) else f"{good} {unit}"
            lines.append(f"{'  ' * depth}{name.Name:<{34 - 2 * depth}}{shown}".rstrip())
            await below(child, depth + 1)

    async def run() -> None:
        client = Client(f"opc.tcp://{place}/rtec", timeout=60)
        client.application_uri = "urn:office"
        own, key, other = (CertProperties(str(keys / n), "pem") for n in ("office.pem", "office.key", "mill.pem"))
        await client.set_security(SecurityPolicyBasic256Sha256, own, key, server_certificate=other)
        async with client:
            await below(client.nodes.objects, 0)

    asyncio.run(run())
    return "\n".join(lines[:45])


def dashboard(path: Path, prometheus: str) -> None:
    """Draw the panels over time of the dashboard, from what Prometheus answers to their queries."""
    from matplotlib.figure import Figure

    panels = json.loads((CONFIGS / "grafana" / "rtec.json").read_text())["panels"]
    panels = [panel for panel in panels if panel["type"] == "timeseries"]
    figure = Figure(figsize=(11, 2.5 * len(panels)), layout="constrained")
    now_s = wall_clock_ns() * 1e-9
    for axes, panel in zip(figure.subplots(len(panels), 1, sharex=True), panels, strict=True):
        for target in panel["targets"]:
            query = target["expr"].replace('{job=~"$job"}', "")
            asked = {"query": query, "start": now_s - SHOWN_S, "end": now_s, "step": 1}
            url = f"http://{prometheus}/api/v1/query_range?{urllib.parse.urlencode(asked)}"
            with urllib.request.urlopen(url) as answer:
                found = json.load(answer)["data"]["result"]
            for one in found:
                name = (
                    one["metric"]
                    .pop("__name__", query.split("[")[0])
                    .replace("increase(", "increase of ")
                    .replace("rtec_", "")
                )
                of = ", ".join(v for k, v in one["metric"].items() if k not in ("job", "instance"))
                times, values = zip(*one["values"], strict=True)
                axes.plot([t - now_s for t in times], [float(v) for v in values], label=f"{name} {of}".strip())
        axes.set_title(panel["title"], loc="left", fontsize=11)
        axes.legend(fontsize=7, ncols=4, loc="upper left")
        axes.margins(y=0.35)
        axes.grid(alpha=0.3)
    axes.set_xlabel("seconds before now")
    figure.savefig(path, dpi=80)


def main(target: Path) -> None:
    """Run all of it, and draw."""
    rtec = [sys.executable, "-m", "rtec.cli.main"]
    places = {name: free_place() for name in ("prometheus", "broker", "mtconnect", "opcua", "server")}
    port = places["broker"].partition(":")[2]
    with tempfile.TemporaryDirectory() as folder, ExitStack() as running:
        run = Path(folder) / "configs" / "turning-centre-sim.toml"
        shutil.copytree(CONFIGS, run.parent)
        certificates(run.parent, "mill", "office")
        (run.parent / "trusted").mkdir()
        shutil.copy(run.parent / "office.pem", run.parent / "trusted")
        # A rate that any computer holds beside five other programs: the pictures are of the clients.
        text = run.read_text().replace("rate_hz = 1000", "rate_hz = 50").replace("max_age_s = 0.005", "max_age_s = 0.1")
        run.write_text(text + TABLES.format(**{**places, "broker": port}))
        (run.parent / "mosquitto.conf").write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n")
        scrape = {"scrape_interval": "1s", "static_configs": [{"targets": [places["prometheus"]]}], "job_name": "rtec"}
        (run.parent / "prometheus.json").write_text(json.dumps({"scrape_configs": [scrape]}))
        running.enter_context(started("/usr/sbin/mosquitto", "-c", str(run.parent / "mosquitto.conf")))
        running.enter_context(
            started(
                "prometheus", f"--config.file={run.parent / 'prometheus.json'}", f"--storage.tsdb.path={folder}/data",
                f"--web.listen-address={places['server']}", "--log.level=error",
            )
        )  # fmt: skip
        running.enter_context(started(*rtec, "run", str(run), "--duration", "600"))
        running.enter_context(started(*rtec, "telemetry", str(run)))
        wait(SHOWN_S + 20)
        terminal(target / "mqtt-subscriber.png", "$ mosquitto_sub -h localhost -t 'shop/#' -F '%t %p'", mqtt(port))
        terminal(target / "mtconnect-agent.png", "$ nc mill 7878", mtconnect(places["mtconnect"]))
        title = "asyncua, Client.nodes.objects: browse names, values, engineering units"
        terminal(target / "opcua-browse.png", title, opcua(places["opcua"], run.parent))
        dashboard(target / "prometheus-dashboard.png", places["server"])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
