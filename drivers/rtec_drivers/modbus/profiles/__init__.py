"""Register maps of Modbus modules, each with its source."""
