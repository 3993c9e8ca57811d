"""Register maps of Modbus modules, each with the document that it stands in."""
