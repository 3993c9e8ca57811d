"""Names of columns in foreign tables: words for roles in several languages, and units in names."""

import re
from collections.abc import Sequence
from typing import Final

from rtec.metrology.readers.delimited import unit_named
from rtec.metrology.units import NO_UNIT, OTHERS, UNITS

WORDS: Final[dict[str, frozenset[str]]] = {
    "time": frozenset(
        {
            "time",
            "t",
            "ts",
            "zeit",
            "timestamp",
            "uhrzeit",
            "zeitstempel",
            "datetime",
            "elapsed",
            "temps",
            "heure",
            "hora",
            "tiempo",
        }
    ),
    "date": frozenset({"date", "datum", "day", "tag", "jour", "fecha"}),
    "run": frozenset(
        {"run", "lauf", "cycle", "zyklus", "zyk", "pass", "durchgang", "durchlauf", "messreihe", "series"}
    ),
    "part": frozenset(
        {"part", "teil", "bauteil", "werkstück", "werkstueck", "workpiece", "piece", "pièce", "pieza", "pezzo"}
    ),
    "direction": frozenset(
        {
            "direction",
            "dir",
            "richtung",
            "sense",
            "fahrtrichtung",
            "verfahrrichtung",
            "anfahrrichtung",
            "anfahrt",
            "approach",
            "approche",
            "sens",
            "sentido",
            "senso",
            "direzione",
        }
    ),
    "nominal": frozenset(
        {
            "soll",
            "sollposition",
            "sollwert",
            "nominal",
            "target",
            "cmd",
            "command",
            "commanded",
            "setpoint",
            "ziel",
            "consigne",
            "consigna",
            "nom",
            "tgt",
            "programmed",
            "theoretical",
            "théorique",
            "nominale",
            "cible",
            "objetivo",
            "teórico",
            "teorico",
            "pos",
            "position",
        }
    ),
    "actual": frozenset(
        {
            "reference",
            "ist",
            "istposition",
            "istwert",
            "actual",
            "act",
            "measured",
            "gemessen",
            "messwert",
            "laser",
            "meas",
            "mesure",
            "mesuré",
            "mesurée",
            "réel",
            "réelle",
            "real",
            "medido",
            "misurato",
            "reale",
        }
    ),
    "deviation": frozenset(
        {
            "abweichung",
            "deviation",
            "dev",
            "error",
            "err",
            "fehler",
            "delta",
            "diff",
            "differenz",
            "reading",
            "residual",
            "abw",
            "ecart",
            "probe",
        }
    ),
    "bar": frozenset({"radius", "r", "length", "länge", "laenge", "rayon", "longueur", "radio", "raggio"}),
    "angle": frozenset({"angle", "winkel", "ang", "theta", "phi"}),
    "temperature": frozenset({"temp", "temperatur", "temperature", "degc", "celsius", "thermocouple", "pt100"}),
    "spindle": frozenset({"rpm", "spindle_rpm", "drehzahl", "spindeldrehzahl", "speed"}),
    "feed": frozenset({"feed", "vorschub", "feedrate"}),
    "load": frozenset({"load", "last", "beladung"}),
    "setting": frozenset({"target", "set", "soll", "setpoint", "cmd"}),
    "index": frozenset(
        {"index", "nr", "no", "sample", "order", "id", "line", "row", "zeile", "punkt", "point", "nummer"}
    ),
    "channel": frozenset(
        {"channel", "kanal", "signal", "tag", "name", "sensor", "variable", "source", "quelle", "item"}
    ),
    "value": frozenset({"value", "wert", "val", "reading", "messwert", "data"}),
    "unit": frozenset({"unit", "einheit", "units"}),
}
DIRECTIONS: Final = {
    "+": 1, "-": -1, "fwd": 1, "bwd": -1, "forward": 1, "backward": -1, "back": -1, "vor": 1, "zurück": -1, "rück": -1,
    "up": 1, "down": -1, "pos": 1, "neg": -1, "hin": 1, "her": -1, "f": 1, "b": -1, "rev": -1, "reverse": -1, "r": -1,
    "forwards": 1, "backwards": -1, "bkwd": -1, "rückwärts": -1, "vorwärts": 1, "zurueck": -1, "rueck": -1,
    "positive": 1, "negative": -1, "positiv": 1, "negativ": -1, "plus": 1, "minus": -1, "auf": 1, "ab": -1,
    "aller": 1, "retour": -1, "avant": 1, "arrière": -1, "ida": 1, "vuelta": -1, "andata": 1, "ritorno": -1,
    "increasing": 1, "decreasing": -1, "inc": 1, "dec": -1, "↑": 1, "↓": -1, "→": 1, "←": -1, "−": -1, "–": -1,
    "return": -1,
}  # fmt: skip
PLACES: Final = {
    "mutter": "nut", "spindelmutter": "nut", "kugelgewindemutter": "nut",
    "bett": "bed", "luft": "air", "umgebung": "air", "raum": "air", "ambient": "air", "room": "air",
    "spindel": "spindle", "vorn": "front", "vorne": "front", "hinten": "rear", "schlitten": "carriage",
    "spindelstock": "headstock", "spindelkasten": "headstock", "öl": "oil", "gestell": "frame", "ständer": "column",
    "säule": "column", "lager": "bearing", "tisch": "table", "werkstück": "workpiece", "maßstab": "scale",
    "kühlmittel": "coolant",
}  # fmt: skip
AXES: Final = frozenset("xyzuvw")
POSITIONS: Final = WORDS["nominal"] | WORDS["actual"]
DELTA: Final = re.compile(r"(?<![^\W_])[dΔ∆][ _]?(?=[XYZUVWxyzuvw](?![^\W_]))")
"""A difference along an axis: `dX`, `ΔX`."""
TURNS_OTHER: Final = re.compile(r"fan|pump|lüfter|ventilator|gebläse|blower|cooler|chiller")
PLACE_WORDS: Final = PLACES.keys() | set(PLACES.values())
MINUS: Final = frozenset("-–−‐‑‒—﹣－") | {"minus", "less", "moins", "menos", "meno"}
AGAINST: Final = frozenset({"vs", "versus", "gegen", "/"})
ENDS: Final = frozenset("=:,;")
LETTERS: Final = {"a": 1, "m": 1, "i": 1, "t": -1, "n": -1, "s": -1}
"""Short for actual, measured, Ist; target, nominal, Soll."""
# Letters with other common meanings: units only in brackets.
NOT_BARE: Final = frozenset({"f", "d", "t", "g", "1", "'", '"', "in", "h"})
DIAMETER: Final = re.compile(r"[⌀∅]|(?<![A-Za-zÀ-ÿ]{2})[Øø](?=[XYZUVWxyzuvw]?(?![A-Za-zÀ-ÿ]))")
DIAMETERS: Final = re.compile(r"dia(m(et[a-zè]*)?)?|di[áà]met\w*|durchm\w*")
"""The sign of a diameter, alone or beside the letter of an axis; and words for one."""


def words_of(name: str) -> list[str]:
    """The words of a name in lower case: `mcu_posZ [mm]` gives mcu, pos, z; `Soll in µm` gives soll; `XIst` x, ist."""
    bare = re.sub(r"([\[(][^\])]*[\])]|\sin\s+\S+)\s*$", "", name)
    bare = DELTA.sub("delta ", DIAMETER.sub(" ", bare))
    apart = re.sub(r"(?<=[a-zäöüß])(?=[A-Z])", " ", bare)
    words = [w.lower() for w in re.split(r"[^A-Za-zÀ-ÿ0-9+]+", apart) if w]
    return [part for w in words for part in ((w[0], w[1:]) if w[0] in AXES and w[1:] in POSITIONS else (w,))]


def direction_meant(word: str) -> int | None:
    """-1 or +1 for a word such as `vor`, `(+)` or `X-`; None where it is no direction."""
    bare = word.lower().strip(" ()[].")
    return DIRECTIONS.get(bare) or DIRECTIONS.get(re.sub(r"^[xyzuvw] ?|[xyzuvw]$", "", bare))


def has(name: str, role: str) -> bool:
    """Whether the name has a word for this role; a single letter means time only if it is alone, unlike `t_nut`."""
    words = words_of(name)
    return any(w in WORDS[role] and (len(w) > 1 or len(words) == 1) for w in words)


def in_diameter(name: str) -> bool:
    """Whether a name has the sign of a diameter, or a word for one: `X Ø [mm]`, `Abw. Durchm.`, `X dia`."""
    words = re.split(r"[^A-Za-zÀ-ÿ]+", re.sub(r"(?<=[a-zäöüß])(?=[A-Z])", " ", name))
    return DIAMETER.search(name) is not None or any(DIAMETERS.fullmatch(w.lower()) for w in words)


def is_nominal(name: str) -> bool:
    """Whether the name means a commanded position and nothing else: `Soll X`, not `bed_target`."""
    words = words_of(name)
    known = WORDS["nominal"] | AXES | {"axis", "achse"}
    return bool(words) and all(w in known for w in words)


def turns_other(name: str) -> bool:
    """Whether a speed is not that of the spindle: of a fan or a pump, or a share of it in %."""
    return "%" in name or TURNS_OTHER.search(name.lower()) is not None


def is_part(name: str) -> bool:
    """Whether the name means the number of a part and nothing else: `Part no`, `Werkstück`, not `Part length`."""
    return has(name, "part") and all(w in WORDS["part"] | WORDS["index"] for w in words_of(name))


def difference(name: str) -> int | None:
    """Whether the name is a difference of an actual and a nominal value, and its order.

    Returns:
        +1: actual minus nominal (`Ist-Soll`); -1: nominal minus actual; 0: the name does not tell the order
        (`Actual vs Target`, and `Soll-Ist-Abweichung`, which means either); None: no difference.
    """
    apart = re.sub(r"(?<=[a-zäöüß])(?=[A-Z])", " ", name)
    words = [w.lower() for w in re.findall(r"[^\W\d_]+|[^\w\s]", apart)]
    for i, mark in enumerate(words):
        if mark not in MINUS | AGAINST:
            continue
        before, after = list(reversed(words[:i])), words[i + 1 :]
        if (
            has(name, "deviation")
            and LETTERS.get(before[0] if before else "", 0) * LETTERS.get("".join(after[:1]), 0) < 0
        ):
            sides = LETTERS[before[0]], LETTERS[after[0]]
        else:
            sides = _side(before), _side(after)
        if sides[0] * sides[1] < 0:
            compound = sides[0] < 0 and any(w in WORDS["deviation"] or w == "vergleich" for w in after)
            return 0 if mark in AGAINST or compound else sides[0]
    return None


def sign_said(remarks: Sequence[tuple[int, str]]) -> tuple[int, int] | None:
    """The order of the difference that a remark of the file gives (`error = nominal - actual`), and its line.

    Args:
        remarks: line numbers and texts of the lines that are no rows.
    """
    for line, text in remarks:
        name, mark, formula = text.partition("=" if "=" in text else ":")
        if mark and has(name, "deviation") and (sign := difference(formula)):
            return sign, line
    return None


def _side(words: list[str]) -> int:
    """+1 where the first word with a role is an actual value, -1 where it is a nominal one, 0 where there is none."""
    for word in words:
        if word in ENDS:
            break
        if word in WORDS["actual"]:
            return 1
        if word in WORDS["nominal"] - {"pos", "position"}:
            return -1
    return 0


def axis_letter(name: str) -> str:
    """The one axis letter in a name: `Pos X [mm]`, `x_cmd`, `X-Soll`; empty where there is none, or two."""
    letters = [w.upper() for w in words_of(name) if w in AXES]
    return letters[0] if len(letters) == 1 else ""


def bare_unit(name: str) -> str:
    """The unit at the end of a name without brackets: `ch1_um`, `Weg/mm`, `T1 °C`; empty where there is none."""
    found = re.search(r"(?:[_/ ]|\bin )([^\s_/\[\]()]+(?:/(?:s|min|m))?)$", name)
    word = found.group(1) if found else ""
    if not word or word.lower() in NOT_BARE:
        return ""
    unit = unit_named(word)
    return unit if unit in UNITS else ""


def unknown_unit(name: str) -> str:
    """What the end of a column's name writes as a unit that rtec does not know: `Error [0.1 µm]`; empty for nothing."""
    found = re.search(r"[\[(]\s*([^\[\]()]+?)\s*[\])]\s*$", name)
    word = found.group(1) if found else ""
    if not word or unit_named(word):
        return ""
    share = re.fullmatch(r"\d[\d.,/]*\s*(\D+)", word)
    small = word.lower()
    other = len(word) > 1 and (small in OTHERS or small in NO_UNIT or small in {"tenths", "lsb", "steps"})
    return word if other or (share and unit_named(share.group(1).strip())) else ""


def is_place(word: str) -> bool:
    """Whether a word is a T with the place of a temperature, like `tnut`."""
    return word.startswith("t") and word[1:] in PLACE_WORDS


def sensor_name(name: str) -> str:
    """Name of a sensor from that of a column: `Mutter [°C]` gives T_nut."""
    words = [w for w in words_of(name) if w not in WORDS["temperature"] and w not in ("t", "deg", "c", "f", "k")]
    words = [w[1:] if re.fullmatch(r"t\d+", w) or is_place(w) else w for w in words]
    plain = "_".join(PLACES.get(w, w) for w in words)
    plain = re.sub(r"\W|[^\x00-\x7f]", "_", plain).strip("_")
    return f"T_{plain}" if plain else "T_1"


def sensors_like(name: str, sensors: tuple[str, ...]) -> tuple[str, ...]:
    """Sensors that a column's name can mean: the one of its name, else those whose names have all its words."""
    words = sensor_name(name).removeprefix("T_").split("_")
    of = {s: [w.lower() for w in re.split(r"[^A-Za-z0-9]+", s.removeprefix("T_")) if w] for s in sensors}
    if exact := sensor_called(name, sensors):
        return (exact,)
    return tuple(s for s, theirs in of.items() if set(words) <= set(theirs))


def sensor_called(name: str, sensors: tuple[str, ...]) -> str:
    """The sensor of exactly this name, of the name derived from it, or of its words in another order; or empty."""
    same = {s.lower(): s for s in sensors}
    if exact := same.get(name.lower().strip()) or same.get(sensor_name(name).lower(), ""):
        return exact
    words = sorted(sensor_name(name).removeprefix("T_").lower().split("_"))
    turned = [s for s in sensors if sorted(s.removeprefix("T_").lower().split("_")) == words]
    return turned[0] if len(turned) == 1 and not PLACE_WORDS.isdisjoint(words) else ""
