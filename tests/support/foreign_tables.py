"""One laser along X of the turning centre while its nut warms, as five other programs would have written it."""

from datetime import datetime, timedelta

import numpy as np

BEGAN = datetime(2026, 11, 21, 8, 0, 0)
PER_DEGREE = 0.012
Row = tuple[float, float, float, float]


def rows() -> list[Row]:
    """Time s, x mm, reading µm, nut °C: six ways along X while the nut warms; the screw grows with it."""
    rng = np.random.default_rng(7)
    out, time_s = [], 0.0
    for way in range(6):
        for x in np.arange(0.0, 201.0, 20.0)[:: 1 if way % 2 == 0 else -1]:
            nut = round(20.0 + 1.2 * way + 0.001 * time_s, 3)
            out.append((time_s, float(x), round(PER_DEGREE * x * (nut - 20.0) + rng.normal(0.0, 0.15), 3), nut))
            time_s += 5.0
        time_s += 900.0
    return out


def comma(value: float) -> str:
    return f"{value:.3f}".replace(".", ",")


def semicolons(data: list[Row]) -> bytes:
    head = "Laserprogramm 3.2\nBediener: Müller\n\nZeit [s];Soll [mm];Abweichung [µm];Mutter [°C]\n"
    return (head + "".join(";".join(map(comma, row)) + "\n" for row in data)).encode("cp1252")


def blanks(data: list[Row]) -> bytes:
    return "".join(f"{t:10.1f}   {x:8.3f}  {e:8.3f} {nut:7.3f}\n" for t, x, e, nut in data).encode()


def fixed_width(data: list[Row]) -> bytes:
    """Every seventh row has no remark, and remarks have blanks in them: only the places divide the cells."""
    head = "  time s   pos X     dev X  T x nut  remark\n       s      mm        um     degC\n"
    marks = ["" if i % 7 else "door was open" for i in range(len(data))]
    lines = [
        f"{t:8.1f}{x:8.1f}{e:10.3f}{nut:9.3f}  {m}".rstrip() for (t, x, e, nut), m in zip(data, marks, strict=True)
    ]
    return (head + "\n".join(lines) + "\n").encode("utf-16")


def date_and_time(data: list[Row]) -> bytes:
    """The laser's own position, not its deviation; the nut in °F."""
    out = ["Date\tTime\tX [mm]\tLaser X [mm]\tT_x_nut [F]"]
    for t, x, e, nut in data:
        when = BEGAN + timedelta(seconds=t)
        out.append(f"{when:%d/%m/%Y}\t{when:%H:%M:%S}\t{x:.1f}\t{x + e / 1000.0:.6f}\t{nut * 1.8 + 32.0:.4f}")
    return "\r\n".join(out).encode()


def events(data: list[Row]) -> bytes:
    out = ["time,channel,value"]
    for t, x, e, nut in data:
        when = (BEGAN + timedelta(seconds=t)).isoformat()
        out += [f"{when},x_cmd,{x}", f"{when},T_x_nut,{nut}", f"{when},laser deviation,{e}"]
    return "\n".join(out).encode()


WRITTEN = {f.__name__: f for f in (semicolons, blanks, fixed_width, date_and_time, events)}
ANSWERS = {
    "semicolons": ["axis=X", "sensor of Mutter [°C]=T_x_nut"],
    "blanks": ["names=t s, x mm, dev um, T_x_nut degC"],
}
