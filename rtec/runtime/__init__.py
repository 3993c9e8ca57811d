"""The running side: clock, records, step, loop, log, replay."""
