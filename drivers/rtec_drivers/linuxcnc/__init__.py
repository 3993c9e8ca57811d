"""LinuxCNC as a device: positions, states and corrections by HAL (`docs/linuxcnc.md`)."""
