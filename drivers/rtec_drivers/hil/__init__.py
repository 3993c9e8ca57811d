"""Hardware in the loop: the simulated machine behind real buses, and the daemon that corrects it (`docs/hil.md`)."""
