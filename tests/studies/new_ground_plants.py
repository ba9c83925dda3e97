"""One plant of new ground: drawn at random, flown without the library, fitted by defaults, judged.

`new_ground.py` states the distribution, runs many and makes the table.
"""

import warnings
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from systems import (
    advance,
    Chirp,
    coloured,
    Continuous,
    from_transfer_function,
    Linear,
    linear,
    multisine,
    respond_smoothly,
    sampled,
)

import jaxquad as jq


LENGTHS = (1200, 2400, 4800)  # samples


class Setting(NamedTuple):
    """One record: what is true, what is flown, and where the fit starts."""

    labels: dict[str, str | float]  # of the categories
    names: tuple[str, ...]
    truth: np.ndarray
    start: Callable[[], object]
    record: Callable[[], jq.Record]


class Roots(NamedTuple):
    """Gain, lag, damping, delay, poles and zeros; pairs as (frequency, damping ratio)."""

    numbers: dict[str, float]
    poles: list
    zeros: list

    def off(self, rng: np.random.Generator) -> "Roots":
        """Every number up to a factor 2 away; roots keep their side."""
        away = lambda x: x * 2 ** rng.uniform(-1, 1)
        some = lambda roots: [
            tuple(map(away, r)) if isinstance(r, tuple) else away(r) for r in roots
        ]
        return Roots(
            {k: away(x) for k, x in self.numbers.items()}, some(self.poles), some(self.zeros)
        )


class Structure(NamedTuple):
    """A lagged integrator, or a transfer function with real roots and pairs."""

    title: str
    order: int
    integrators: int
    zeros: int = 0
    lagged: bool = False
    damped: bool = False


STRUCTURES = (
    Structure("lag", 1, 0, lagged=True),
    Structure("integrator, lag", 2, 1, lagged=True),
    Structure("2 integrators, lag", 3, 2, lagged=True),
    Structure("damped integrator, lag", 2, 1, lagged=True, damped=True),
    Structure("0 zeros, 2 poles", 2, 0),
    Structure("1 zero, 2 poles", 2, 0, 1),
    Structure("0 zeros, 3 poles", 3, 0),
    Structure("1 zero, 3 poles", 3, 0, 1),
    Structure("1 zero, 4 poles", 4, 0, 1),
    Structure("2 zeros, 4 poles", 4, 0, 2),
    Structure("0 zeros, integrator, 2 poles", 3, 1),
    Structure("1 zero, integrator, 2 poles", 3, 1, 1),
)


def logarithmic(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def polynomial(roots: list) -> np.ndarray:
    """Monic, of roots -a and pairs (omega, zeta)."""
    product = np.ones(1)
    for root in roots:
        factor = (
            [1.0, 2 * root[1] * root[0], root[0] ** 2] if isinstance(root, tuple) else [1.0, root]
        )
        product = np.convolve(product, factor)
    return product


def draw_roots(rng: np.random.Generator, structure: Structure, low: float, top: float, dt: float):
    """Poles, zeros and times within the band (rad/s); the gain is 1."""
    pair = lambda least: (logarithmic(rng, 1.5 * low, 0.8 * top), logarithmic(rng, least, 0.95))
    numbers = {"gain": 1.0, "delay": dt * rng.uniform(0, 5)}
    if structure.lagged:
        numbers["lag"] = 1 / logarithmic(rng, 0.2 * top, 3 * top)
        if structure.damped:
            numbers["damping"] = logarithmic(rng, 0.3 * low, top)
        return Roots(numbers, [], [])
    poles, left = [], structure.order - structure.integrators
    while left:
        in_pairs = left > 1 and rng.uniform() < 0.5
        poles += (
            [pair(0.03)] if in_pairs else [logarithmic(rng, low, top) for _ in range(min(left, 2))]
        )
        left -= min(left, 2)
    zeros = [pair(0.05)] if structure.zeros == 2 else []
    if structure.zeros == 1:
        zeros = [logarithmic(rng, low, 2 * top) * (1 if rng.uniform() < 0.8 else -1)]
    return Roots(numbers, poles, zeros)


def coefficients(structure: Structure, roots: Roots) -> tuple[np.ndarray, np.ndarray]:
    numbers, n = roots.numbers, structure.integrators
    above, below = numbers["gain"] * polynomial(roots.zeros), polynomial(roots.poles)
    if structure.lagged:
        above, below = above / numbers["lag"], np.array([1.0, 1 / numbers["lag"]])
        if structure.damped:
            below, n = np.convolve(below, [1.0, numbers["damping"]]), 0
    return above, np.concatenate([below, np.zeros(n)])


def parameters(structure: Structure, roots: Roots) -> tuple[tuple[str, ...], np.ndarray]:
    """The free parameters of the library's model, by name."""
    if structure.lagged:
        names = ("gain", "lag", "delay", *(["damping"] if structure.damped else []))
        return names, np.array([roots.numbers[name] for name in names])
    above, below = coefficients(structure, roots)
    poles = structure.order - structure.integrators
    names = [f"numerator[{k}]" for k in range(above.size)]
    names += [f"denominator[{k}]" for k in range(1, poles + 1)]
    return (*names, "delay"), np.array([*above, *below[1 : poles + 1], roots.numbers["delay"]])


def model_of(structure: Structure, roots: Roots):
    if structure.lagged:
        return jq.LaggedIntegrator(**roots.numbers, integrators=structure.integrators)
    return jq.TransferFunction(*coefficients(structure, roots), delay=roots.numbers["delay"])


def wave_of(rng, kind: str, low: float, top: float, samples: int, dt: float):
    """A function of time where there is one, and its samples."""
    time, seconds = dt * np.arange(samples), dt * samples
    if kind == "sweep":
        wave = Chirp(low, top, 0.85 * seconds, 0.03 * seconds, 1.0, 0.03 * seconds)
        return wave, wave(time)
    if kind == "multisine":
        values = multisine(int(rng.integers(2**31)), low, top, samples, dt)
        lines = np.fft.rfft(values)
        used = np.flatnonzero(np.abs(lines) > 1e-9 * np.abs(lines).max())
        turns, sizes = 2j * np.pi * used / seconds, 2 * lines[used] / samples

        fade = lambda t: 0.5 - 0.5 * np.cos(np.pi * np.clip(t / (0.03 * seconds), 0, 1))

        def line_sum(t: np.ndarray) -> np.ndarray:
            total = np.zeros(t.size)
            for turn, size in zip(turns, sizes, strict=True):
                total += np.real(size * np.exp(turn * t))
            return fade(t) * total

        return line_sum, fade(time) * values
    if kind == "prbs":
        clock = max(1, round(2.8 / (top * dt)))
        return None, np.repeat(rng.choice([-1.0, 1.0], samples // clock + 1), clock)[:samples]
    pieces = [np.zeros(samples // 50)]
    while sum(map(len, pieces)) < 0.85 * samples:
        half = max(1, round(2.3 / (logarithmic(rng, 1.5 * low, top) * dt)))
        pieces += [np.ones(half), -np.ones(half), np.zeros(2 * half)]
    return None, np.pad(np.concatenate(pieces), (0, samples))[:samples]


def noise_of(rng, colour: str, samples: int, dt: float, corner: float) -> np.ndarray:
    white = rng.standard_normal(samples)
    if colour == "white":
        return white
    slow = coloured(rng, samples, dt, corner)
    return slow if colour == "coloured" else (white + slow) / np.sqrt(2)


def in_loop(
    plant: Continuous, dt: float, gains: tuple[float, float, float], at_input: bool
) -> Linear:
    """From (excitation, noise) to (u, y), with a PID whose derivative is filtered."""
    held, share = sampled(plant, dt), 1 - np.exp(-0.5)
    n, (kp, ki, kd) = held.size, gains

    def step(x, w):
        integral, smooth = x[n:]
        y = held.C[0] @ x[: len(held.A)] + w[1]
        error = (0.0 if at_input else w[0]) - y
        slope = share / dt * (error - smooth)
        u = kp * error + ki * integral + kd * slope + (w[0] if at_input else 0.0)
        moved = advance(held, x[:n], np.array([u]), np.zeros(1))
        return np.append(
            moved, [integral + dt * error, smooth + share * (error - smooth)]
        ), np.array([u, y])

    return linear(step, n + 2, 2)


def draw_loop(
    rng: np.random.Generator, plant: Continuous, dt: float, low: float, at_input: bool, samples: int
) -> tuple[Linear, str] | None:
    """A controller whose loop settles within a tenth of the record with |S| below 4; None where
    thirty draws have none. In units in which the band ends at 1."""
    s = 1j * np.geomspace(0.2 * low, 3 / dt, 300)
    G = plant.response(s.imag)[:, 0, 0]
    for _ in range(30):
        cross, kind = logarithmic(rng, 1.5 * low, 0.6), str(rng.choice(["P", "PI", "PD"]))
        ki = 0.2 * cross if kind == "PI" else 0.0
        kd = logarithmic(rng, 0.5, 3) / cross if kind == "PD" else 0.0
        C = lambda s, ki=ki, kd=kd: 1 + ki / s + kd * s
        k = 1 / abs(C(1j * cross) * plant.response(np.array([cross]))[0, 0, 0])
        for signed in (k, -k):
            loop = in_loop(plant, dt, (signed, signed * ki, signed * kd), at_input)
            integral = len(loop.A) - 2
            used = [n for n in range(len(loop.A)) if ki or n != integral]
            fade = np.abs(np.linalg.eigvals(loop.A[np.ix_(used, used)])).max() ** (samples / 10)
            if fade < np.exp(-3) and np.abs(1 / (1 + signed * C(s) * G)).max() < 4:
                return loop, kind
    return None


def draw(seed: int, number: int) -> Setting:
    """Plant `number` of a seed; where no loop suits it, it is drawn again."""
    for attempt in range(100):
        setting = _draw(np.random.default_rng([seed, number, attempt]))
        if setting is not None:
            return setting
    raise RuntimeError(f"seed {seed}, plant {number}: no loop in 100 draws")


def _draw(rng: np.random.Generator) -> Setting | None:
    structure = STRUCTURES[rng.integers(len(STRUCTURES))]
    samples, dt = int(rng.choice(LENGTHS)), logarithmic(rng, 0.002, 0.05)
    top = rng.uniform(0.15, 0.6) / dt
    low = top / logarithmic(rng, 8, min(60, max(9, samples * dt * top / 19)))
    roots = draw_roots(rng, structure, low, top, dt)
    middle = 1j * np.sqrt(low * top)
    above, below = coefficients(structure, roots)
    gain = logarithmic(rng, 0.1, 10) * rng.choice([-1, 1])
    roots.numbers["gain"] = float(gain / abs(np.polyval(above, middle) / np.polyval(below, middle)))
    above, below = coefficients(structure, roots)
    # In units of 1 / top, so that all coefficients are of the order of 1.
    scale = lambda c, order: c / top ** (order - np.arange(c.size)[::-1])
    plant = from_transfer_function(
        scale(above, below.size - 1), scale(below, below.size - 1), roots.numbers["delay"] * top
    )
    step, closed = dt * top, structure.integrators == 2 or rng.uniform() < 0.5
    excitation = str(rng.choice(["sweep", "multisine", "prbs", "doublets"]))
    smooth = excitation in ("sweep", "multisine") and not closed and rng.uniform() < 1 / 3
    colour = str(rng.choice(["white", "coloured", "both"]))
    level, at_input = logarithmic(rng, 0.01, 0.5), bool(rng.uniform() < 0.5)
    corner = logarithmic(rng, low, top) / top
    wave, u = wave_of(rng, excitation, low / top, 1.0, samples, step)
    loop = "open"
    if closed:
        found = draw_loop(rng, plant, step, low / top, at_input, samples)
        if found is None:
            return None
        system, kind = found
        loop = f"{kind}, {'command' if at_input else 'set-point'}"
    before = samples // 4 if closed else 0
    noise = level * noise_of(rng, colour, samples + before, step, corner)
    start = roots.off(rng)

    def record() -> jq.Record:
        time = dt * np.arange(samples)
        if not closed:
            if smooth and wave is not None:
                drive = wave
                fine = step / 6  # of Simpson's rule: the input's mean over a step
                mean = lambda t: (
                    (drive(t - fine / 2) + 4 * drive(t) + drive(t + fine / 2))[:, None] / 6
                )
                y = respond_smoothly(plant, mean, step * np.arange(samples), fine)[:, 0]
            else:
                held = sampled(plant, step)
                passed = lambda x, w: (advance(held, x, w, np.zeros(1)), held.C @ x[: len(held.A)])
                y = linear(passed, held.size, 1).run(u[None, :, None])[0, :, 0]
            return jq.Record(time, u, y + noise * y.std(), hold=0.0 if smooth else dt)
        w = np.zeros((2, samples + before, 2))
        w[0, before:, 0], w[1, :, 1] = u, noise
        clean, disturbed = system.run(w)[:, before:]
        flown = clean + disturbed * clean[:, 1].std()
        return jq.Record(time, flown[:, 0], flown[:, 1], u, hold=dt)

    names, truth = parameters(structure, roots)
    low_noise = "1 to 3 %" if level < 0.03 else "3 to 15 %" if level < 0.15 else "15 to 50 %"
    labels = {
        "structure": structure.title, "order": f"order {structure.order}",
        "loop": "closed loop" if closed else "open loop", "noise": f"noise {low_noise}",
        "colour": f"noise {colour}" if colour != "both" else "noise white and coloured",
        "excitation": excitation, "hold": "not held" if smooth else "held",
        "length": f"{samples} samples", "controller": loop, "level": level, "dt": dt,
        "band": f"{low:.3g} .. {top:.3g} rad/s",
    }  # fmt: skip
    return Setting(labels, names, truth, lambda: model_of(structure, start), record)


def identify(setting: Setting):
    """What a user calls."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", jq.records.RecordWarning)
        response = jq.frequency_response(setting.record())
    return response, jq.fit(setting.start(), response, free=setting.names)


def true_combination(name: str, sum_of: tuple[str, ...], truth: dict[str, float]) -> float:
    """The truth of a printed `lag + delay` or `gain^2 / (lag delay)`."""
    if sum_of:
        signs = [1.0, *(1.0 if word == "+" else -1.0 for word in name.split() if word in "+-")]
        signs = [-1.0, *signs[2:]] if name.startswith("-") else signs
        return float(sum(s * truth[each] for s, each in zip(signs, sum_of, strict=True)))
    value, power = 1.0, 1
    for word in name.split():
        if word == "/":
            power = -1
            continue
        factor, _, exponent = word.strip("()").partition("^")
        value *= 1.0 if factor == "1" else abs(truth[factor]) ** (power * float(exponent or 1))
    return value


def nearest_truth(setting: Setting, fitted: dict[str, float]) -> dict[str, float]:
    """The true values; of a lag and a damping, which can change places, in the order of the fit."""
    truth = dict(zip(setting.names, map(float, setting.truth), strict=True))
    if "damping" not in truth:
        return truth
    lag, damping = truth["lag"], truth["damping"]
    swapped = truth | {"gain": truth["gain"] / (lag * damping), "lag": 1 / damping}
    far = lambda one: abs(np.log(max(fitted["lag"], 1e-9) / one["lag"]))
    return min(truth, swapped | {"damping": 1 / lag}, key=far)


def claimed_errors(value: float, ends: tuple[float, float], truth: float) -> float:
    """By how many a value is off: its interval's side towards the truth is 1.96 of them."""
    side = value - ends[0] if value > truth else ends[1] - value
    return 1.96 * float(value - truth) / max(float(side), 1e-300)


def judge(setting: Setting) -> dict:
    """One plant: all that is printed without a mark, against the truth."""
    try:
        response, fit = identify(setting)
    except ValueError as error:
        return {
            "kind": "error",
            "remarks": [f"ValueError: {error}"],
            "of_response": [],
            "undetermined": [],
            "numbers": [],
            "misfit": None,
        }
    truth = nearest_truth(setting, dict(zip(fit.names, fit.values, strict=True)))
    bounds = {bound.name: bound for bound in fit.verdict.bounds}
    numbers = []
    for k, name in enumerate(fit.names):
        if not fit.determined[k]:
            continue
        low, high = fit.interval(name)
        off = claimed_errors(fit.values[k], (low, high), truth[name])
        if name in bounds:  # its limit is 1.645 errors away
            off = -1.645 * abs(truth[name] / bounds[name].limit)
            off = off if abs(off) > 1.645 else 0.0
        numbers.append([name, off, bool(low <= truth[name] <= high)])
    for each in fit.combinations:
        right = true_combination(each.name, each.sum_of, truth)
        low, high = each.interval
        off = claimed_errors(each.value, (low, high), right)
        numbers.append([each.name, off, bool(low <= right <= high)])
    remarks, informed = ([f"{x.kind}: {x}"[:160] for x in each.remarks] for each in (fit, response))
    return {
        "kind": fit.verdict.kind,
        "undetermined": list(fit.verdict.undetermined),
        "numbers": numbers,
        "remarks": remarks,
        "of_response": informed,
        "misfit": float(fit.chi_squared**0.5),
    }
