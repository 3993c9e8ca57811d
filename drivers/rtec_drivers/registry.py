"""The drivers that come with rtec: name -> (module, class), imported only when named.

Other packages add theirs by the entry point `rtec.drivers`, with a table of the same form.
"""

DRIVERS: dict[str, tuple[str, str]] = {
    "sim": ("rtec_drivers.sim", "SimDriver"),
}
