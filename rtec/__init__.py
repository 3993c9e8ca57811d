"""rtec: real-time error correction for machine tools, and what its models still miss.

    import rtec

    model = rtec.load_model("model.toml")
    model.predict(X=100.0, Z=[-200.0, 0.0], T_x_nut=24.5, dir_X=1)
    rtec.diagnose(model, "laser-x.csv").plot()

The functions are those of `rtec.api`, which is imported at the first use of one of them.
"""

from typing import TYPE_CHECKING

from rtec.version import __version__

if TYPE_CHECKING:
    from rtec.api import (
        add,
        ballbar,
        compare,
        diagnose,
        drift,
        fit,
        grid,
        history,
        import_table,
        improve,
        iso230,
        load_machine,
        load_measurement,
        load_model,
        parallelism,
        plan,
        propose_import,
        replay,
        simulate,
        straightness,
    )
    from rtec.errors import RtecError

__all__ = [
    "RtecError",
    "__version__",
    "add",
    "ballbar",
    "compare",
    "diagnose",
    "drift",
    "fit",
    "grid",
    "history",
    "import_table",
    "improve",
    "iso230",
    "load_machine",
    "load_measurement",
    "load_model",
    "parallelism",
    "plan",
    "propose_import",
    "replay",
    "simulate",
    "straightness",
]


if not TYPE_CHECKING:  # a type checker knows the names above, and no others

    def __getattr__(name: str) -> object:
        if name not in __all__:
            raise AttributeError(f"module 'rtec' has no attribute {name!r}")
        from importlib import import_module

        value: object = getattr(import_module("rtec.errors" if name == "RtecError" else "rtec.api"), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*(name for name in globals() if name.startswith("__")), *__all__})
