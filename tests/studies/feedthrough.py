"""A held command that passes directly to an output, late by a part of a sample.

    python tests/studies/feedthrough.py --draws 100

An independent simulation by scipy's matrix exponential; each draw has other delays, of 0 to 6
samples, and starts two samples beside them.
"""

import argparse
from typing import NamedTuple

import numpy as np
from result_files import write
from scipy.linalg import expm

import jaxquad as jq


jq.enable_x64()
DT, LENGTH = 0.01, 60.0  # s


class Plant(NamedTuple):
    """x' = A x + B u, y = C x + D u, with a delay at each input."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray

    def respond(self, u: np.ndarray, delays: np.ndarray) -> np.ndarray:
        """The outputs at the samples of held inputs, from rest."""
        states, y = len(self.A), np.zeros((len(u), len(self.C)))
        for source, delay in enumerate(delays):
            whole = int(np.ceil(delay / DT - 1e-9))
            early = whole * DT - delay  # the part of a sample in which the new value acts
            padded = np.concatenate([np.zeros(whole + 1), u[:, source]])

            def over(span: float, b=self.B[:, source]) -> tuple[np.ndarray, np.ndarray]:
                block = np.zeros((states + 1, states + 1))
                block[:states, :states], block[:states, states] = self.A * span, b * span
                step = expm(block)
                return step[:states, :states], step[:states, states]

            (last, new), (_, old) = over(early), over(DT - early)
            step, x = over(DT)[0], np.zeros(states)
            for k in range(len(u)):
                # The value of the sample `whole` back is already there; the state lags behind it.
                y[k] += self.C @ x + self.D[:, source] * padded[k + 1]
                following = padded[k + 2] if k + 2 < len(padded) else 0.0
                x = step @ x + last @ old * padded[k + 1] + new * following
        return y


def sweep(low: float, high: float, start: float, samples: int) -> np.ndarray:
    time = DT * np.arange(samples) - start
    turns = low * LENGTH / np.log(high / low) * (np.exp(time / LENGTH * np.log(high / low)) - 1)
    return np.where((time >= 0) & (time < LENGTH), np.sin(turns), 0.0)


class Setting(NamedTuple):
    title: str
    plant: Plant
    model: jq.TransferFunction | jq.StateSpace  # without delays, with the true values
    delays: tuple[str, ...]
    free: tuple[str, ...]
    noise: tuple[float, ...]


def rational(title: str, numerator, denominator, noise: float) -> Setting:
    """A transfer function with as many zeros as poles, in controllable form."""
    above, below = np.asarray(numerator, float), np.asarray(denominator, float)
    order = below.size - 1
    A = np.eye(order, k=-1)
    A[0] = -below[1:]
    plant = Plant(A, np.eye(order, 1), (above[1:] - above[0] * below[1:])[None], above[:1, None])
    names = [f"numerator[{k}]" for k in range(order + 1)]
    names += [f"denominator[{k}]" for k in range(1, order + 1)]
    model = jq.TransferFunction(above, below)
    return Setting(title, plant, model, ("delay",), (*names, "delay"), (noise,))


def helicopter() -> Setting:
    """Heave and pitch at 20 m/s: pitch rate and vertical acceleration by collective and cyclic."""
    A, B = np.array([[-0.8, 20.0], [-0.1, -2.5]]), np.array([[-9.0, 2.0], [0.4, 6.0]])
    H0, H1 = np.array([[0.0, 1.0], [0.0, -20.0]]), np.array([[0.0, 0.0], [1.0, 0.0]])
    plant = Plant(A, B, H0 + H1 @ A, H1 @ B)
    model = jq.StateSpace(F=A, G=B, H0=H0, H1=H1, input_delay=np.full(2, 1.0))
    free = ("F[0][0]", "F[1][0]", "F[1][1]", "G[0][0]", "G[0][1]", "G[1][0]", "G[1][1]")
    delays = ("input_delay[0]", "input_delay[1]")
    return Setting("helicopter", plant, model, delays, (*free, *delays), (0.02, 0.2))


SETTINGS = (
    rational("(s + 5) / (s + 2)", [1.0, 5.0], [1.0, 2.0], 0.02),
    rational("flexible, 2 poles", [0.5, 1.0, 60.0], [1.0, 3.0, 100.0], 0.02),
    rational("the same, noise tenfold", [0.5, 1.0, 60.0], [1.0, 3.0, 100.0], 0.2),
    helicopter(),
)


def place(name: str) -> tuple[str, tuple[int, ...]]:
    field, *index = name.replace("]", "").split("[")
    return field, tuple(map(int, index))


def numbers(model, names) -> np.ndarray:
    """The model's values by their names."""
    places = map(place, names)
    return np.array([float(np.asarray(getattr(model, field))[index]) for field, index in places])


def with_numbers(model, names, values):
    """The model with these values, by their names."""
    arrays = {}
    for name, value in zip(names, values, strict=True):
        field, index = place(name)
        arrays.setdefault(field, np.array(getattr(model, field), float))[index] = value
    if isinstance(model, jq.TransferFunction):
        parts = {k: arrays.get(k, getattr(model, k)) for k in ("numerator", "denominator", "delay")}
        return jq.TransferFunction(**parts)
    parts = {k: getattr(model, k) for k in ("F", "G", "H0", "H1", "input_delay")}
    return jq.StateSpace(**{**parts, **arrays})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--only", type=int, help="one setting, nothing is written")
    given = parser.parse_args()
    rows = []
    for setting in SETTINGS if given.only is None else SETTINGS[given.only : given.only + 1]:
        count, rng = len(setting.delays), np.random.default_rng(17)
        samples = int((count * (LENGTH + 2) + 3) / DT)
        u = np.stack([sweep(0.5, 60.0, k * (LENGTH + 2), samples) for k in range(count)], axis=1)
        scaled, inside, said = [], [], []
        for _ in range(given.draws):
            delays = rng.uniform(0.0, 6 * DT, count)
            y = setting.plant.respond(u, delays)
            y += rng.normal(0, setting.noise, y.shape)
            truth = with_numbers(setting.model, setting.delays, delays)
            beside = np.maximum(delays + rng.choice([-2 * DT, 2 * DT], count), 0.3 * DT)
            start = with_numbers(truth, setting.delays, beside)
            record = jq.Record(DT * np.arange(samples), u, y, hold=DT)
            fit = jq.fit(start, jq.frequency_response(record), free=setting.free)
            values = numbers(truth, setting.free)
            ends = np.array([fit.interval(name) for name in setting.free])
            scaled.append((fit.values - values) / fit.standard_errors)
            inside.append((ends[:, 0] <= values) & (values <= ends[:, 1]))
            said.append(any(remark.kind == "sampled delay" for remark in fit.remarks))
        scaled, inside = np.array(scaled), np.array(inside)
        for k, name in enumerate(setting.free):
            row = [
                setting.title, name, 100 * inside[:, k].mean(), scaled[:, k].mean(),
                scaled[:, k].std(), np.abs(scaled[:, k]).max(), 100 * np.mean(said),
            ]  # fmt: skip
            rows.append(row)
            print(*(x if isinstance(x, str) else f"{x:.3g}" for x in row), flush=True)
    if given.only is None:
        write("feedthrough", {
            "title": "A held command that passes directly",
            "command": f"python tests/studies/feedthrough.py --draws {given.draws}",
            "text": f"Plants with a direct part behind a hold of {DT} s; delays of 0 to 6 samples "
            "at random, the start two samples beside them; sweeps from .5 to 60 rad/s in "
            f"{LENGTH:g} s for each input, white noise; {given.draws} draws of each. "
            "\"With the sample's remark\" is where the sample of the direct part is all that is "
            "known of a delay.",
            "columns": ["plant", "parameter", "coverage %", "bias / claimed", "scatter / claimed",
                        "worst / claimed", "with the sample's remark %"],
            "rows": rows,
        })  # fmt: skip


if __name__ == "__main__":
    main()
