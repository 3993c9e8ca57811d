"""Measuring: what instruments read, files of measurements, characterisation, ISO 230 statistics."""
