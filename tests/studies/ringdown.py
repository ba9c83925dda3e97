"""A record that ends while a light mode rings: errors of the response over the claimed ones.

    python tests/studies/ringdown.py --draws 40

The sweep is written here, the plants are simulated by scipy at the samples of a held input; records
end with the sweep, or 3 s later. Default estimator, 80 frequencies of the sweep's band.
"""

import argparse
from typing import cast, NamedTuple

import numpy as np
from result_files import write
from scipy import signal

import jaxquad as jq


jq.enable_x64()
DT, LENGTH = 0.02, 60.0  # s


class Setting(NamedTuple):
    """A sum of gain w^2 / (s^2 + 2 zeta w s + w^2), held input; noise relative to the output."""

    modes: tuple[tuple[float, float, float], ...]  # w in rad/s, zeta, gain
    last: float  # rad/s, end of the sweep
    noise: float
    rest: float = 0.0  # s

    def __str__(self) -> str:
        modes = ", ".join(f"{w:g} rad/s (damping {zeta:g})" for w, zeta, _ in self.modes)
        return f"{modes}; noise {100 * self.noise:g} %" + f"; rest {self.rest:g} s" * (
            self.rest > 0
        )


SETTINGS = (
    Setting(((3.0, 0.05, 1.0),), 5.0, 0.02),
    Setting(((3.0, 0.05, 1.0),), 5.0, 0.05),
    Setting(((20.0, 0.01, 1.0),), 30.0, 0.02),
    Setting(((20.0, 0.05, 1.0),), 30.0, 0.05),
    Setting(((20.0, 0.05, 1.0),), 30.0, 0.005),
    Setting(((10.0, 0.02, 1.0),), 15.0, 0.02),
    Setting(((10.0, 0.02, 1.0),), 15.0, 0.02, 3.0),
    Setting(((4.0, 0.02, 1.0), (9.0, 0.02, 0.6), (16.0, 0.015, 0.4)), 22.0, 0.02),
    Setting(((5.0, 0.5, 1.0),), 22.0, 0.05),
)


def sweep(last: float, rest: float) -> np.ndarray:
    """Logarithmic from 0.3 rad/s, faded in and out over 2 s."""
    time = np.arange(0.0, LENGTH, DT)
    rate = np.log(last / 0.3)
    phase = 0.3 * LENGTH / rate * np.expm1(rate * time / LENGTH)
    fade = np.clip(time / 2, 0, 1) * np.clip((LENGTH - time) / 2, 0, 1)
    return np.concatenate([fade * np.sin(phase), np.zeros(round(rest / DT))])


def simulate(setting: Setting, u: np.ndarray, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Output at the samples, and the response to the held input."""
    y, response, z = np.zeros(u.size), np.zeros(omega.size, complex), np.exp(1j * omega * DT)
    for w, zeta, gain in setting.modes:
        held = signal.cont2discrete(([gain * w**2], [1, 2 * zeta * w, w**2]), DT)
        above, below, _ = cast(tuple[np.ndarray, np.ndarray, float], held)
        y += signal.lfilter(above[0], below, u)
        response += np.polyval(above[0], z) / np.polyval(below, z)
    return y, response


def row(setting: Setting, seed: int, draws: int, order: int) -> list[float | str]:
    u, omega = sweep(setting.last, setting.rest), np.geomspace(0.6, 0.96 * setting.last, 80)
    y, exact = simulate(setting, u, omega)
    estimator = jq.spectra.LocalPolynomial(global_order=order)
    ratios, masked, relative, remarked = [], 0, [], 0
    for draw in range(draws):
        noise = np.random.default_rng([seed, draw]).standard_normal(y.size)
        record = jq.Record(DT * np.arange(u.size), u, y + setting.noise * np.std(y) * noise)
        found = jq.frequency_response(record, omega, estimator=estimator)
        measured = np.asarray(found.response)[:, 0, 0]
        claimed = np.asarray(found.random_error)[:, 0, 0] * np.abs(measured)
        off = measured - exact
        ratios.append(np.abs([np.real(off), np.imag(off)]) / claimed)
        relative.append(np.abs(off / exact))
        masked += int(np.sum(np.isnan(measured)))
        remarked += bool(found.remarks)
    worst = np.nanmax(ratios, axis=(1, 2))
    every = np.array(ratios)[np.isfinite(ratios)]
    return [
        str(setting),
        100 * float(np.nanmedian(np.nanmax(relative, axis=1))),
        float(np.median(worst)),
        float(np.max(worst)),
        100 * float(np.mean(every < 1.96)),
        100 * masked / (draws * omega.size),
        100 * remarked / draws,
    ]


COLUMNS = [
    "modes; noise relative to the output",
    "worst error, median record (%)",
    "worst error / claimed, median record",
    "the same, worst record",
    "coverage of 95 % (%)",
    "points masked (%)",
    "records remarked (%)",
]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=40)
    draws = parser.parse_args().draws
    tables = []
    assert __doc__ is not None
    for order, title in (
        (12, "Ring-down at the end of a record"),
        (0, "The same, no global model"),
    ):
        rows = [row(setting, seed, draws, order) for seed, setting in enumerate(SETTINGS)]
        tables.append(
            {
                "title": title,
                "command": f"python tests/studies/ringdown.py --draws {draws}",
                "text": f"{__doc__.splitlines()[0]} {draws} records of 60 s at 50 Hz each; "
                "`LocalPolynomial" + ("()`." if order else "(global_order=0)`."),
                "columns": COLUMNS,
                "rows": rows,
            }
        )
        for each in rows:
            print(" | ".join(x if isinstance(x, str) else f"{x:.3g}" for x in each), flush=True)
    write("ringdown", tables)


if __name__ == "__main__":
    main()
