"""Looks at every device of a run file, all at once: opens it, reads it, tells what is wrong and how to mend it.

No device is told to apply anything. One that hangs holds up no other: each has a deadline, and what hangs is told.
"""

import os
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from rtec.doctor.advice import serial_places
from rtec.doctor.doctor_look import Look
from rtec.doctor.found import DeviceFound, Examination, Fault, Patient
from rtec.doctor.ports import ROOT
from rtec.errors import RtecError
from rtec.loop.clock import Clock, RealClock
from rtec.loop.run_file import RunFile, load_setup
from rtec.machine import load_machine
from rtec.tomlfile import read_toml, validated

OPEN_S = 35.0
"""Longest wait for a device to open: drivers may be told to wait up to 30 s for theirs."""
CLOSE_S = 5.0
SHOW_NS = 100_000_000
Shown = Callable[[list[DeviceFound]], None]


def load_patient(path: Path, root: Path = ROOT) -> tuple[Patient, list[Fault], tuple[str, ...] | None]:
    """Read a run file as far as its devices need it: a machine that has no model yet can have its devices looked at.

    Returns:
        the patient; what would keep `rtec run` from starting; the sensors that the model reads, None without a model.

    Raises:
        ConfigError: the run file or the machine file is wrong.
    """
    file = validated(RunFile, read_toml(path), str(path))
    machine = load_machine(path.parent / file.run.machine)
    patient = Patient(path, file, machine, root)
    try:
        model = load_setup(path).model
    except RtecError as e:
        return patient, [Fault(line) for line in str(e).splitlines()], None
    return patient, [], tuple(n for n in machine.sensor_names if n in model.channels)


def examine(
    path: Path,
    seconds: float,
    shown: Shown = lambda _: None,
    clock: Clock | None = None,
    root: Path = ROOT,
    open_s: float = OPEN_S,
) -> Examination:
    """Look at all devices of a run file at once.

    Args:
        path: of the run file.
        seconds: how long each is read.
        shown: is given what was found so far, ten times a second.
        clock: the real one where not given.
        root: where this computer's files are.
        open_s: longest wait for a device to open.

    Raises:
        ConfigError: the run file or the machine file is wrong.
    """
    clock = clock or RealClock()
    patient, wrong, needed = load_patient(path, root)
    looks = [Look(name, patient, clock, seconds) for name in patient.file.device]
    threads = [threading.Thread(target=k.run, name=f"rtec-{k.found.name}", daemon=True) for k in looks]
    for thread in threads:
        thread.start()
    try:
        _wait(looks, threads, shown, clock, clock.now_ns() + round((open_s + seconds + CLOSE_S) * 1e9))
    finally:
        for look in looks:
            look.stop.set()
    for look, thread in zip(looks, threads, strict=True):
        if thread.is_alive():
            what = f"hangs while it {look.found.doing}: no end within {open_s:g} s"
            look.found.wrong.append(
                Fault(what, ("unplug the device and plug it in again; then start rtec doctor again",))
            )
    wrong += _one_port(looks, root) + _missing(patient, looks, needed)
    return Examination(patient.machine.name, seconds, [look.found for look in looks], wrong)


def _wait(looks: list[Look], threads: list[threading.Thread], shown: Shown, clock: Clock, end_ns: int) -> None:
    while any(t.is_alive() for t in threads) and clock.now_ns() < end_ns:
        shown([replace(look.found, values=look.values()) for look in looks])
        clock.sleep_until_ns(clock.now_ns() + SHOW_NS)


def _one_port(looks: list[Look], root: Path) -> list[Fault]:
    """Serial ports that several devices of the run file name; each would get a part of the bytes, or none."""
    users: dict[str, list[str]] = {}
    for look in looks:
        for place in serial_places(look.options) if look.options is not None else []:
            users.setdefault(os.path.realpath(place.device(root) or place.usb_serial), []).append(look.found.name)
    return [
        Fault(f"{', '.join(names)} name the same serial port, {port}", ("one device, one port",))
        for port, names in users.items()
        if len(names) > 1
    ]


def _missing(patient: Patient, looks: list[Look], needed: tuple[str, ...] | None) -> list[Fault]:
    """Sensors that the model reads, or without a model the machine file names, and no device gave."""
    given = set().union(*(look.sensors for look in looks))
    lacking = [n for n in (patient.machine.sensor_names if needed is None else needed) if n not in given]
    if not lacking:
        return []
    who = "the machine file names them" if needed is None else "the model reads them, so the correction would hold"
    sources = ", ".join(patient.file.role.temperatures)
    where = f"[role] temperatures names {sources}" if sources else "[role] temperatures names no device"
    return [Fault(f"no device gave {', '.join(lacking)}: {who}", (where,))]
