"""The drivers that come with rtec: name -> (module, class), imported only when named.

Other packages register theirs at the entry point `rtec.drivers`, with a table of the same form.
"""

DRIVERS: dict[str, tuple[str, str]] = {
    "sim": ("rtec_drivers.sim", "SimDriver"),
    "serial_box": ("rtec_drivers.box.driver", "SerialBoxDriver"),
    "ascii_lines": ("rtec_drivers.ascii.driver", "AsciiLinesDriver"),
    "ascii_offset": ("rtec_drivers.ascii.offset", "AsciiOffsetDriver"),
    "modbus": ("rtec_drivers.modbus.driver", "ModbusDriver"),
    "can": ("rtec_drivers.can.driver", "CanDriver"),
    "can_encoders": ("rtec_drivers.can.encoders", "CanEncodersDriver"),
    "can_box": ("rtec_drivers.can.box", "CanBoxDriver"),
    "linuxcnc": ("rtec_drivers.linuxcnc.driver", "LinuxCncDriver"),
    "zmq_link": ("rtec_drivers.zmq.driver", "ZmqLinkDriver"),
}
