import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxquad.records import Record


class Agreement(eqx.Module):
    """How well one output, or all of them together, agree with what was measured."""

    name: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    rms: float  # J_rms, of the difference, in the unit
    tic: float  # Theil inequality coefficient, 0 to 1
    fit_percent: float  # 100 (1 - |difference| / |measured - mean|), the normalised rms fit
    variance_percent: float  # 100 (1 - |difference|^2 / |measured - mean|^2), accounted for

    def __str__(self) -> str:
        return (
            f"fit {self.fit_percent:.1f} %, variance accounted for {self.variance_percent:.1f} %, "
            f"TIC {self.tic:.3f} (good below 0.25), J_rms {self.rms:.4g} {self.unit}"
        ).rstrip()


class Verification(eqx.Module):
    """A model's simulated outputs beside measured ones (CIFER's VERIFY).

    `rms`, `tic`, `fit_percent` and `variance_percent` are those of all outputs together under the
    weights, `outputs` holds those of each. With one output, `measured` and `simulated` have no
    axis of outputs. Guidelines: a Theil inequality coefficient below 0.25 is good agreement.
    """

    time: Float[np.ndarray, " samples"]  # s
    measured: Float[np.ndarray, " samples *outputs"]  # within the band, if there is one
    simulated: Float[np.ndarray, " samples *outputs"]
    rms: float
    tic: float
    fit_percent: float
    variance_percent: float
    outputs: tuple[Agreement, ...]
    shift: Float[np.ndarray, " outputs"]  # reference shifts of the outputs
    bias: Float[np.ndarray, " states"]  # on the state derivatives, of `jq.realise(model)`
    initial: Float[np.ndarray, " states"]  # state at the first sample, of what decays
    omitted: int = eqx.field(static=True)  # starting transients that the record does not show
    band: tuple[float, float] | None = eqx.field(static=True)  # rad/s

    @property
    def output_name(self) -> str:
        """Names of the outputs."""
        return ", ".join(one.name for one in self.outputs)

    @property
    def output_unit(self) -> str:
        """The unit of the outputs, empty where they have several."""
        units = {one.unit for one in self.outputs}
        return units.pop() if len(units) == 1 else ""

    def __str__(self) -> str:
        where = "whole band"
        if self.band:
            where = f"{self.band[0]:.4g}..{self.band[1]:.4g} rad/s"
        numbers = (self.rms, self.tic, self.fit_percent, self.variance_percent)
        whole = Agreement(self.output_name, self.output_unit, *numbers)
        lines = [f"verification on {self.output_name}, {where}: {whole}"]
        if len(self.outputs) > 1:
            lines += [f"  {one.name}: {one}" for one in self.outputs]
        return "\n".join(lines)


def agreement(
    name: str,
    unit: str,
    measured: Float[np.ndarray, "samples outputs"],
    simulated: Float[np.ndarray, "samples outputs"],
    weights: Float[np.ndarray, " outputs"],
) -> Agreement:
    """The textbook's measures over some outputs.

    Source: Tischler & Remple, sec. 14.2, J_rms and TIC with a diagonal weight W.
    """
    size = lambda x: float(np.sqrt(np.mean(x**2 * weights)))
    rms, spread = size(measured - simulated), size(measured - measured.mean(axis=0))
    return Agreement(
        name,
        unit,
        rms,
        rms / (size(measured) + size(simulated)),
        100 * (1 - rms / spread),
        100 * (1 - (rms / spread) ** 2),
    )


def agreements(
    record: Record,
    measured: Float[np.ndarray, "samples outputs"],
    simulated: Float[np.ndarray, "samples outputs"],
    weights: Float[np.ndarray, " outputs"],
) -> tuple[Agreement, tuple[Agreement, ...]]:
    """Of all outputs together, and of each."""
    one = np.ones(1)
    each = [
        agreement(name, unit, measured[:, [k]], simulated[:, [k]], one)
        for k, (name, unit) in enumerate(zip(record.output_names, record.output_units, strict=True))
    ]
    return agreement("", "", measured, simulated, weights), tuple(each)
