#!/usr/bin/env python3
"""Breaks the gateware in one place at a time; the simulation's tests must notice (`make mutants` in the top folder).

`mutants.py` tries all; `mutants.py WORDS` those whose name has these words. Each names the test that must fail, so that
it takes seconds. Exit status 1: a test passed on broken gateware.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

BOX = Path(__file__).parents[1]
TOP = BOX.parents[1]
LINES, LINK, RANGES = (f"tests/box/test_gateware_{name}.py::test_" for name in ("lines", "link", "ranges"))
MUTANTS = {
    "the filter takes a clock more": (
        "filter.v", "lasted >= length", "lasted > length", LINES + "what_is_shorter_than_the_filter_leaves_no_trace",
    ),
    "the index is latched a count late": (
        "inserter.v", "at_index <= raw + (raw_up ? 1 : raw_down ? -1 : 0)", "at_index <= raw",
        LINES + "the_index_passes_and_its_count_is_kept",
    ),
    "the index comes a clock early": (
        "inserter.v", "z_late <= index[SEPARATION-1]", "z_late <= index[SEPARATION-2]",
        LINES + "the_index_keeps_its_place_while_counts_are_inserted",
    ),
    "counts are inserted too fast": (
        "inserter.v", "to_wait <= insert ? interval", "to_wait <= insert ? interval >> 1",
        LINES + "counts_come_no_faster_than_the_board_says",
    ),
    "the limit is not kept": (
        "box.v", "above ? most :", "above ? waits :", LINK + "the_limit_holds_whatever_is_asked",
    ),
    "the relay is early": (
        "box.v", "relay <= !rst && settled[SETTLED];", "relay <= !rst && settled[SETTLED-1];",
        LINES + "the_relay_waits_until_the_outputs_follow",
    ),
    "silence leaves the target": (
        "link.v", "target <= inserted;", "target <= target;", LINES + "silence_in_the_middle_of_a_way",
    ),
    "counters do not wrap at their width": (
        "link.v", "raw[32*i+:32] & mask", "raw[32*i+:32]", LINK + "counters_wrap_at_their_width",
    ),
    "a command of another start is taken": (
        "link.v", "resumed && asked_boot == boot;", "resumed;", LINK + "a_conversation",
    ),
    "the time is not latched": (
        "link.v", "latched_us <= time_us;", "latched_us <= 0;", LINK + "a_conversation",
    ),
    "a broken encoder is resumed": (
        "link.v", "asked_boot == boot && !broken", "asked_boot == boot",
        RANGES + "a_broken_encoder_is_not_resumed",
    ),
    "a wrong CRC is taken": (
        "frame_in.v", "done <= good;", "done <= 1;", LINK + "garbage_is_passed_over",
    ),
    "a zero is not stuffed": (
        "frame_out.v", "if (value == 0) zero <= to;", "", LINK + "a_conversation",
    ),
    "a bit is looked at at its end": (
        "uart.v", "in_wait <= MIDDLE;", "in_wait <= LAST;", LINK + "the_other_end_has_a_clock_of_its_own",
    ),
    "a spike is a start bit": (
        "uart.v", "if (in_bit == 1 && synced[1]) in_bit <= 0;", "if (0) in_bit <= 0;",
        RANGES + "a_spike_on_the_serial_line_is_no_start_bit",
    ),
    "SPI sends a byte again in the next transfer": (
        "spi.v", "loaded <= tx_valid && !rst;", "loaded <= 0;",
        LINK + "an_answer_over_spi_may_be_read_in_pieces",
    ),
    "the longest silence is never over": (
        "watchdog.v", "reg [16:0] silent_ms;", "reg [15:0] silent_ms;", RANGES + "the_longest_silence",
    ),
    "every start has the same number": (
        "boot.v", "number <= number + !(known || heard);", "number <= 7;",
        LINK + "spi_carries_the_same_frames_and_each_start_has_its_number",
    ),
}  # fmt: skip


def noticed(file: str, old: str, new: str, test: str) -> bool:
    """Does the test fail on gateware with one piece replaced?"""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in ("gateware", "sim"):
            shutil.copytree(BOX / part, folder / part)
        shutil.copy(BOX / "Makefile", folder)
        source = folder / "gateware" / file
        text = source.read_text(encoding="utf-8")
        if text.count(old) != 1:
            sys.exit(f"{file}: {old!r} is {text.count(old)} times in it; correct the mutant")
        source.write_text(text.replace(old, new), encoding="utf-8")
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-p", "no:cacheprovider", test]
        given = {**os.environ, "RTEC_GATEWARE": name, "TMPDIR": name}
        done = subprocess.run(command, cwd=TOP, env=given, capture_output=True, text=True, check=False)  # noqa: S603 (ours)
    if done.returncode not in (0, 1) or "%Error" in done.stdout or "make: ***" in done.stdout:
        sys.exit(f"{test} could not be run:\n{done.stdout[-2000:]}{done.stderr[-500:]}")
    return done.returncode == 1


def main(words: str) -> int:
    """Try the mutants; give the exit status."""
    bad = 0
    for name, mutant in MUTANTS.items():
        if words in name:
            good = noticed(*mutant)
            bad += not good
            sys.stdout.write(f"mutant, {name}: {'noticed' if good else 'NOT NOTICED'}\n")
            sys.stdout.flush()
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main(" ".join(sys.argv[1:])))
