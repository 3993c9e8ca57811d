"""One cycle: clock, records, step, loop, and the state that outlives the process."""
