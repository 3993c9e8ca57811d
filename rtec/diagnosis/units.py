"""Units and channels as people write them; files and JSON keep the codes."""

WORDS = {
    "um": "µm", "urad": "µrad", "degc": "K", "degC": "°C", "deg": "°", "krpm": "(1000/min)", "kn": "kN",
    "100kg": "(100 kg)", "1": "", "krpm2": "(1000/min)²", "krpm_to_p": "(1000/min)^p", "s2": "s²", "m2": "m²",
    "mm/s2": "mm/s²", "noise": "× noise",
}  # fmt: skip
NAMED = {
    "spindle_rpm": "spindle speed, rpm",
    "load_kg": "load, kg",
    "force_n": "force, N",
    "feed_mm_min": "feed, mm/min",
    "time_s": "time, s",
    "run": "run",
}
OF_AXIS = {
    "d": "last direction of {}",
    "v": "velocity of {}, mm/s",
    "a": "acceleration of {}, mm/s²",
    "s": "distance since {} turned round, mm",
}


def spoken(unit: str) -> str:
    """A unit as people write it: `um_per_m_degc` is µm/(m·K), `degC` °C, and `1` nothing."""
    if unit.endswith("krpm_to_p"):
        return f"{WORDS[unit.split('_', maxsplit=1)[0]]}/(1000/min)^p"
    above, _, below = unit.partition("_per_")
    top = "·".join(WORDS.get(w, w) for w in above.split("_"))
    parts = [WORDS.get(w, w) for w in below.split("_")] if below else []
    if not parts:
        return top
    return f"{top or '1'}/{parts[0]}" if len(parts) == 1 else f"{top or '1'}/({'·'.join(parts)})"


def titled(channel: str, unit: str = "") -> str:
    """A channel as the title of an axis of a figure: `x` is "X, mm", `s_y` "distance since Y turned round, mm".

    Args:
        channel: name of the channel.
        unit: its code, where it is known: a sensor may have any name.
    """
    if unit == "degC" or channel.startswith("T_"):
        return f"{channel}, °C"
    if channel in NAMED:
        return NAMED[channel]
    head, mark, rest = channel.partition("_")
    if mark and head in OF_AXIS:
        return OF_AXIS[head].format(rest.upper())
    return f"{channel.upper()}, mm"


def named(channel: str) -> str:
    """A channel within a sentence: the same without its unit."""
    return titled(channel).rpartition(", ")[0] or titled(channel)
