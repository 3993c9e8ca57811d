"""A compiled model for many instants at once: what `Model.predict` gives, many times faster."""

from dataclasses import dataclass
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from rtec.effects import State, derived
from rtec.model.kernel import build as elementary
from rtec.model.kernel.build import build_module
from rtec.model.kernel.write import EXTRA_ARRAYS, KernelSource, slow_inputs, write_kernel
from rtec.model.model import Model

Floats = NDArray[np.float64]

IMPORTS = "\nfrom rtec.effects.derived import lag_update\nfrom rtec.model.kernel.build import sin_cos\n\n\n"

EVALUATE = '''

@njit
def evaluate(time_s, {arrays}, u, p, m, lags, tip, components):
    """Tip error and component errors at n instants, in order."""
    for i in range(len(time_s)):
        fresh = i == 0 or lags > 0
        if not fresh:
            for k in range(u.shape[1]):
                if u[i, k] != u[i - 1, k]:
                    fresh = True
        if fresh:
            slow_part(m, p, u[i], time_s[i] - time_s[max(i - 1, 0)], i == 0)
        out = fast_part(m, {rows})
        tip[i, 0], tip[i, 1], tip[i, 2] = out[0], out[1], out[2]
        {store}
'''


@dataclass(frozen=True)
class CompiledModel:
    """A model's kernel over arrays."""

    model: Model
    source: KernelSource
    module: ModuleType

    def predict(self, state: State) -> tuple[Floats, Floats]:
        """Tip error, µm, (n, 3), and the errors of `source.components`, (n, components)."""
        n = len(state)
        tip, components = np.zeros((n, 3)), np.zeros((n, max(1, len(self.source.components))))
        self.module.evaluate(
            np.ascontiguousarray(state.time_s, dtype=np.float64),
            np.ascontiguousarray(state.positions_mm()),
            *(self._of_axes(state, name) for name in self.source.arrays[1:]),
            self._slow_inputs(state),
            self.model.parameter_values(),
            np.zeros(self.source.memory),
            self.source.lags,
            tip,
            components,
        )
        return tip, components[:, : len(self.source.components)]

    def _of_axes(self, state: State, array: str) -> Floats:
        """One of the kernel's arrays over the axes, (n, axes); zero where the model does not read the channel."""
        axes = self.model.machine.axes
        out = np.zeros((len(state), len(axes)))
        for i, axis in enumerate(axes):
            channel = axis.direction_channel if array == "d" else EXTRA_ARRAYS[array](axis)
            if channel in self.model.channels:
                out[:, i] = state.value(channel)
        return out

    def _slow_inputs(self, state: State) -> Floats:
        names = slow_inputs(self.model.machine)
        out = np.zeros((len(state), len(names)))
        for i, name in enumerate(names):
            if name in self.model.channels:
                out[:, i] = state.value(name)
        return out


def compile_model(model: Model) -> CompiledModel:
    """Compile a model for arrays; quick where the same structure was compiled before."""
    source = write_kernel(model)
    store = "; ".join(f"components[i, {k}] = out[{k + 3}]" for k in range(len(source.components))) or "pass"
    rows = ", ".join(f"{name}[i]" for name in source.arrays)
    evaluate = EVALUATE.replace("{store}", store).replace("{arrays}", ", ".join(source.arrays)).replace("{rows}", rows)
    text = IMPORTS + source.text + evaluate
    return CompiledModel(model, source, build_module(text, [derived, elementary]))
