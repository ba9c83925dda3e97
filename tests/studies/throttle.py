"""b0 over the throttle from simulated flights: how often its 95 % band holds the truth.

    python tests/studies/throttle.py --flights 200

Half of the flights are logged at 1 kHz, half at 2 kHz. Beside it what direct least squares of y''
on u gives in four bands of frequency, as the ratio to the true b0.
"""

import argparse

import numpy as np
import throttle_flights as simulated

import jaxquad as jq
from jaxquad.autopilot import FilterChain, Notch, PT1


CHAINS = (FilterChain((PT1(500.0),), 8000.0), FilterChain((Notch(190.0, 3.0), PT1(350.0)), 4000.0))
BANDS = ((1.5, 4.0), (3.0, 8.0), (8.0, 20.0), (20.0, 45.0))  # Hz
BETWEEN = (0.35, 0.55)  # throttles at which nothing was flown
SEED = 20261122


def record_of(flights: simulated.Flights, k: int) -> jq.Record:
    """One flight as a blackbox gives it."""
    inputs = np.stack([flights.command[:, k], 1000 * flights.throttle[:, k]], axis=1)
    return jq.Record(
        flights.time,
        inputs,
        flights.gyro[:, k],
        flights.setpoint[:, k],
        input_names=("axisSum[0]", "throttle"),
        output_names="gyroADC[0]",
        output_units="deg/s",
        reference_names="setpoint[0]",
        hold=1 / 4000,
    )


def errors(truth, flights, k: int) -> tuple[list[float], list[bool], float]:
    """Relative errors and whether the bands hold the truth: at each level, then between them."""
    found = jq.identify.gain_over_throttle(
        record_of(flights, k), throttle_range=(0.0, 1000.0), filters=CHAINS
    )
    each = [found.b0(level) for level in range(found.throttle.size)]
    true = [truth.b0(x)[k] for x in (*found.throttle, *BETWEEN)]
    law = found.b0_over(np.array(BETWEEN))
    values = [*(b.value for b in each), *law.value]
    bands = [*(b.interval for b in each), *zip(law.low, law.high, strict=True)]
    inside = [bool(low <= b <= high) for (low, high), b in zip(bands, true, strict=True)]
    curve = found.curve
    assert curve is not None
    low, high = curve.interval
    inside.append(bool(low <= truth.curve[k] <= high))
    relative = [value / b - 1 for value, b in zip(values, true, strict=True)]
    return relative, inside, curve.value - float(truth.curve[k])


def direct_ratios(truth, flights, k: int) -> np.ndarray:
    """b0 by direct least squares over the true one, (levels, bands)."""
    third = len(flights.time) // 3
    parts = [slice(p * third, (p + 1) * third) for p in range(3)]
    true = [truth.b0(flights.throttle[part, k].mean())[k] for part in parts]
    return np.array(
        [
            [simulated.direct_least_squares(flights, k, part, band) / b for band in BANDS]
            for part, b in zip(parts, true, strict=True)
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="b0 over the throttle from simulated flights")
    parser.add_argument("--flights", type=int, default=40)
    count = parser.parse_args().flights
    jq.enable_x64()
    rng = np.random.default_rng(SEED)
    relative, inside, curves, direct = [], [], [], []
    for log_rate in (1000, 2000):
        truth = simulated.draw(rng, count // 2)
        flights = simulated.fly(truth, rng, log_rate)
        for k in range(count // 2):
            far, held, curve = errors(truth, flights, k)
            relative.append(far)
            inside.append(held)
            curves.append(curve)
            direct.append(direct_ratios(truth, flights, k))
    places = [f"level {k + 1}" for k in range(3)] + [f"at {x:.2f}" for x in BETWEEN]
    print(f"{len(inside)} flights of {simulated.SECONDS} s, seed {SEED}")
    print(f"{'b0':<10} {'rms error %':>12} {'in its 95 % band, %':>20}")
    rms, held = np.sqrt(np.mean(np.square(relative), axis=0)), np.mean(inside, axis=0)
    for place, error, share in zip(places, rms, held, strict=False):
        print(f"{place:<10} {100 * error:12.2f} {100 * share:20.1f}")
    print(f"f: rms error {np.std(curves):.4f}, in its 95 % band {100 * held[-1]:.1f} %")
    half = len(inside) // 2
    for name, part in (("1 kHz", inside[:half]), ("2 kHz", inside[half:])):
        print(f"levels, log at {name}: {100 * np.mean(np.array(part)[:, :3]):.1f} % in their bands")
    print("direct least squares of y'' on u over the true b0: median (5 .. 95 % of flights)")
    for b, band in enumerate(BANDS):
        ratios = np.array(direct)[:, :, b]
        low, middle, high = np.percentile(ratios, [5, 50, 95])
        twice = 100 * np.mean((ratios < 0.5) | (ratios > 2))
        print(
            f"  {band[0]:4.1f} .. {band[1]:4.1f} Hz: {middle:.2f} ({low:.2f} .. {high:.2f}), "
            f"off by more than a factor of two in {twice:.0f} %"
        )


if __name__ == "__main__":
    main()
