"""A simulated log whose true model is known."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxquad._core import write_file
from jaxquad.datasets import FILES, locate
from jaxquad.excitation import sweep

from ._settings import IdentifySettings


_RATE, _GAIN, _LAG, _DELAY = 250.0, 280.0, 0.02, 0.008  # Hz, rad/s^2 per unit of M, s, s
_FEEDBACK = 0.02  # of M per rad/s
_GUST, _CORNER, _NOISE = 2.0, 3.0, 0.01  # rad/s^2, rad/s, rad/s
DEMO_TRUTH: Mapping[str, float] = {"gain": _GAIN, "lag": _LAG, "delay": _DELAY}
DEMO = IdentifySettings(
    input="M", output="q", reference="x0", units={"q": "rad/s"}, band=(0.5, 12.0), hold="dt"
)


def write_demo_log(path: str | Path, seed: int = 0) -> Path:
    """Write time, reference x0, command M and rate q as CSV; the same for the same seed.

    An axis under rate feedback, in gusts, is excited by a sweep of its command. `DEMO` holds the
    settings to identify it with, `DEMO_TRUTH` the true parameters.
    """
    low, high = 2 * np.pi * 0.4, 2 * np.pi * 15
    signal = sweep(low, high, duration=40, sample_rate=_RATE, amplitude=0.06)
    # M = x0 - feedback q, held for a sample; q' = gain M(t - delay) behind a lag, and gusts.
    random, samples = np.random.default_rng(seed), signal.signal.size
    noise, shocks = random.standard_normal((2, samples))
    dt, late = 1 / _RATE, round(_DELAY * _RATE)
    stay, decay = np.exp(-dt / _LAG), np.exp(-_CORNER * dt)
    command, measured = np.zeros((2, samples))
    rate = moment = gust = 0.0
    for k in range(samples):
        measured[k] = rate + _NOISE * noise[k]
        command[k] = signal.signal[k] - _FEEDBACK * measured[k]
        delayed = command[k - late] if k >= late else 0.0
        # The lag's exact mean over the sample, in which its input is constant.
        mean = delayed + (moment - delayed) * (1 - stay) * _LAG / dt
        rate += dt * (_GAIN * mean + gust)
        moment = delayed + (moment - delayed) * stay
        gust = decay * gust + _GUST * np.sqrt(1 - decay**2) * shocks[k]
    columns = (signal.time, signal.signal, command, measured)
    rows = ("{:.6f},{:.8g},{:.8g},{:.8g}\n".format(*row) for row in zip(*columns, strict=True))
    return write_file(Path(path), f"time,x0,M,q\n{''.join(rows)}")


def find_demo_flight() -> tuple[Path, IdentifySettings]:
    """The measured flight of `jaxquad demo --flight`, and the settings to identify it with.

    **Raises:**

    - `ReadError`: it is neither on this machine nor can it be downloaded.
    """
    path = locate(FILES["antx_pitch prbs"])
    field = ".value" if path.suffix == ".mat" else ""  # its publisher's file has structs
    return path, IdentifySettings(
        input=f"M{field}", output=f"q{field}", reference=f"x0{field}",
        units={f"q{field}": "rad/s"}, rate=250.0, start=50.0, stop=76.0, band=(0.7, 12.0),
    )  # fmt: skip
