"""The encoder box on a serial port (`docs/rtec-box-link.md`), and one in software."""
