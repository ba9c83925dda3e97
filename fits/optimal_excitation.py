"""Design the shortest flight: an optimal multisine against the standard sweep, at equal limits.

A pitch-rate response of five parameters under white sensor noise. Predicted from the Fisher
information of the actual signals, then flown `--draws` times in simulation and identified. Prints
the seconds for equal accuracy and writes JSON and a figure under results/optimal_excitation.
"""

import argparse
import functools as ft
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

import jaxquad as jq
from jaxquad import design as jd
from jaxquad._core import as_float


jq.enable_x64()

RATE = 200.0  # Hz
BAND = (0.5, 40.0)  # rad/s
AMPLITUDE = 0.2  # rad of stick or elevator
NOISE = 0.2  # rad/s, standard deviation of a sample of the rate
DENSITY = 2 * NOISE**2 / RATE  # one-sided, per Hz
SETTLE = 2.0  # s of multisine before the periods that count: eight time constants
SWEEP = jq.sweep(*BAND, duration=60.0, sample_rate=RATE, amplitude=AMPLITUDE)
OMEGA = np.geomspace(*BAND, 100)
PERIOD = 4.5  # s


class RateResponse(eqx.Module):
    """K wn^2 exp(-delay s) / ((s^2 + 2 zeta wn s + wn^2) (tau s + 1)), stick to rate."""

    K: Float[Array, ""] = eqx.field(converter=as_float)  # 1/s
    tau: Float[Array, ""] = eqx.field(converter=as_float)  # s
    zeta: Float[Array, ""] = eqx.field(converter=as_float)
    wn: Float[Array, ""] = eqx.field(converter=as_float)  # rad/s
    delay: Float[Array, ""] = eqx.field(converter=as_float)  # s

    def transfer_function(self) -> jq.TransferFunction:
        one = jnp.ones_like(self.K)
        second = jnp.stack([one, 2 * self.zeta * self.wn, self.wn**2])
        denominator = jnp.convolve(second, jnp.stack([self.tau, one]))
        return jq.TransferFunction((self.K * self.wn**2)[None], denominator, self.delay)

    def frequency_response(
        self, omega: Float[Array, " frequencies"]
    ) -> Complex[Array, "frequencies 1 1"]:
        return self.transfer_function().frequency_response(omega)


PLANT = RateResponse(18.0, 0.045, 0.55, 7.0, 0.018)
NAMES = ("K", "tau", "zeta", "wn", "delay")
TRUTH = np.array([float(getattr(PLANT, name)) for name in NAMES])
# Before the flight a model is known roughly, and none of these is right.
GUESSES = [
    RateResponse(25.0, 0.03, 0.7, 9.0, 0.027),
    RateResponse(12.0, 0.06, 0.4, 5.5, 0.012),
    RateResponse(14.0, 0.03, 0.5, 8.5, 0.025),
]

best_multisine = ft.partial(
    jd.optimal_multisine,
    noise=DENSITY,
    band=BAND,
    sample_rate=RATE,
    amplitude=AMPLITUDE,
    rate=AMPLITUDE * BAND[1],  # the sweep's at its end
)


class Flown(NamedTuple):
    """Many flights of one signal: predicted, stated and observed relative errors."""

    name: str
    seconds: float  # of flight, with what settles and what is trim
    predicted: jd.Prediction
    stated: np.ndarray
    observed: np.ndarray


def multisine_record(design: jd.Design, rng: np.random.Generator) -> jq.Record:
    """What counts of a flight that starts `SETTLE` before its first whole period."""
    wave = design.excitation.signal
    before = round(SETTLE * RATE)
    record = record_of(np.concatenate([wave[-before:], wave]), rng)
    return jq.Record(record.time[:-before], record.inputs[before:], record.outputs[before:])


def record_of(signal: np.ndarray, rng: np.random.Generator) -> jq.Record:
    clean = jq.models.simulate_linear(PLANT.transfer_function(), signal, 1 / RATE, hold="first")
    noisy = np.asarray(clean) + NOISE * rng.standard_normal(signal.size)
    return jq.Record(np.arange(signal.size) / RATE, signal, noisy)


def identify(record: jq.Record, omega: np.ndarray | None, estimator: Any) -> jq.identify.Fit:
    frf = jq.frequency_response(record, omega, estimator=estimator)
    return jq.fit(GUESSES[1], frf, min_coherence=0.05)


def fly(
    name: str, seconds: float, predicted: jd.Prediction, fits: Sequence[jq.identify.Fit]
) -> Flown:
    values = np.array([fit.values for fit in fits]) / TRUTH
    stated = np.array([fit.standard_errors for fit in fits]) / TRUTH
    stated = np.sqrt(np.mean(stated**2, axis=0))
    return Flown(name, seconds, predicted, stated, values.std(axis=0, ddof=1))


def shortest(model: Any, target: float, name: str) -> jd.Design:
    """The multisine with the fewest whole periods that reaches the sweep's worst error."""
    design = ft.partial(best_multisine, model, period=PERIOD, criterion=jd.LargestError())
    one = jd.predict_accuracy(PLANT, design(periods=1).excitation, noise=DENSITY)
    seconds = one.seconds_for(target).max()
    found = design(periods=int(np.ceil(seconds / PERIOD)))
    print(f"\n{name}: {found}\n{seconds:.1f} s of it would do for the sweep's worst error")
    return found


def compare_criteria(sweep: jd.Prediction) -> None:
    """Seconds of each kind of multisine for the error that the sweep leaves in each parameter."""
    print(f"\nexcited seconds for the errors that {SWEEP.duration:.0f} s of sweep leave, predicted")
    print(f"{'criterion':<14}" + "".join(f"{n:>8}" for n in NAMES) + f"{'region':>9}{'worst':>8}")
    for criterion in (jd.DOptimal(), jd.AOptimal(), jd.LargestError()):
        found = best_multisine(PLANT, period=20.0, periods=1, criterion=criterion).prediction
        seconds = [*found.seconds_for(sweep.standard_errors)]
        region = (sweep.log_determinant - found.log_determinant) / len(NAMES)
        seconds += [found.seconds * np.exp(region)]
        seconds += [found.seconds_for(sweep.standard_errors.max()).max()]
        cells = "".join(f"{each:8.1f}" for each in seconds[:-2])
        print(f"{type(criterion).__name__:<14}{cells}{seconds[-2]:9.1f}{seconds[-1]:8.1f}")


def row(flown: Flown) -> str:
    lines = [f"{flown.name}, {flown.seconds:.1f} s of flight"]
    for label, numbers in (
        ("predicted", 100 * flown.predicted.standard_errors),
        ("stated by the fits", 100 * flown.stated),
        ("scatter of the fits", 100 * flown.observed),
        ("predicted CR", flown.predicted.cramer_rao),
    ):
        lines.append(f"  {label:<24}" + "".join(f"{number:9.2f}" for number in numbers))
    return "\n".join(lines)


def figure(design: jd.Design) -> Any:
    """Spectra of both signals, and what power at each offered line would pay."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(6.5, 6.0), layout="constrained")
    top, bottom = canvas.subplots(2, 1)
    _draw_spectra(top, design)
    bottom.plot(design.offered, design.dispersion, "-o", lw=0.8, color="0.15", mfc="none")
    used = np.isin(design.offered, design.omega)
    bottom.plot(design.omega, design.dispersion[used], "s", ms=5, color="tab:blue", label="used")
    bottom.axhline(len(NAMES), color="tab:red", ls="--", label="number of parameters")
    bottom.set(ylabel="dispersion function", xlabel="frequency, rad/s")
    for axis in (top, bottom):
        axis.set(xscale="log", xlim=(0.4, 60.0))
        axis.legend(fontsize=9)
        axis.grid(True, which="both", color="0.9", lw=0.5)
    return canvas


def _draw_spectra(axis: Any, design: jd.Design) -> None:
    dt, inside = 1 / RATE, slice(round(SWEEP.lead * RATE), -round(SWEEP.tail * RATE))
    signal = SWEEP.signal[inside]
    omega = 2 * np.pi * np.fft.rfftfreq(signal.size, dt)
    density = 2 * dt * np.abs(np.fft.rfft(signal)) ** 2 / signal.size
    shown = (omega > 0.4) & (omega < 60)
    axis.plot(omega[shown], density[shown], color="0.55", lw=0.9, label="sweep")
    spacing = design.offered[1] - design.offered[0]
    lines = design.power / (spacing / (2 * np.pi))
    axis.vlines(design.omega, 1e-6, lines, color="tab:blue", lw=1.2)
    axis.plot(design.omega, lines, "s", ms=4, color="tab:blue", label="optimal multisine")
    axis.set(yscale="log", ylabel="power density, rad²/Hz")
    axis.set_ylim(density[shown].max() * 1e-4, 2 * max(density[shown].max(), lines.max()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=60, help="simulated flights of each signal")
    parser.add_argument("--out", type=Path, default=Path("results/optimal_excitation"))
    options = parser.parse_args()
    began = time.perf_counter()

    predicted = jd.predict_accuracy(PLANT, SWEEP, noise=DENSITY)
    target = float(predicted.standard_errors.max())
    print(f"{SWEEP}\n{predicted}")
    compare_criteria(predicted)
    designs = {
        "multisine for the true plant": shortest(PLANT, target, "true plant"),
        "multisine for three guesses": shortest(GUESSES, target, "three guesses"),
    }
    rng = np.random.default_rng(1)
    fits = [
        identify(record_of(SWEEP.signal, rng), OMEGA, jq.spectra.LocalPolynomial())
        for _ in range(options.draws)
    ]
    flights = [fly("sweep", float(SWEEP.time[-1]), predicted, fits)]
    for name, design in designs.items():
        averaged = jq.spectra.Periodic(PERIOD, discard=0)
        fits = [
            identify(multisine_record(design, rng), None, averaged) for _ in range(options.draws)
        ]
        seconds = SETTLE + design.excitation.duration
        predicted = jd.predict_accuracy(PLANT, design.excitation, noise=DENSITY)
        flights.append(fly(name, seconds, predicted, fits))
    print(f"\nrelative errors in per cent, {options.draws} flights each")
    print(" " * 26 + "".join(f"{name:>9}" for name in NAMES))
    print("\n".join(map(row, flights)))
    for flown in flights[1:]:
        print(f"{flown.name}: {flights[0].seconds - flown.seconds:.1f} s of flight saved")

    options.out.mkdir(parents=True, exist_ok=True)
    table = {f.name: {"seconds": f.seconds, "predicted": f.predicted.standard_errors.tolist(),
                      "stated": f.stated.tolist(), "observed": f.observed.tolist()}
             for f in flights}  # fmt: skip
    text = json.dumps({"parameters": NAMES, "relative_standard_errors": table}, indent=2)
    (options.out / "result.json").write_text(text + "\n")
    figure(designs["multisine for the true plant"]).savefig(options.out / "design.png", dpi=130)
    seconds = time.perf_counter() - began
    print(f"\n{options.out}: result.json, design.png; {seconds:.1f} s")


if __name__ == "__main__":
    jq.enable_compile_cache()
    main()
