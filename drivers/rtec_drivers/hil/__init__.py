"""Hardware in the loop: the simulated machine behind real buses, and the daemon run against it (`docs/hil.md`)."""
