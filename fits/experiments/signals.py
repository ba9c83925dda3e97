"""Signals of the suite from their data."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxquad.excitation import Excitation, harmonics, multisine, sweep
from jaxquad.simulation import (
    ceti_gust,
    Gust,
    Pulse,
    Scenario,
    scenario,
    Sine,
    SmoothStep,
    Step,
    WhiteNoise,
)

from .data import Case, Members


_MAKERS = {
    "step": Step, "smooth_step": SmoothStep, "sine": Sine, "pulse": Pulse, "gust": Gust,
    "ceti": ceti_gust, "white": WhiteNoise,
}  # fmt: skip
_BY_MEMBER = ("after", "before", "amplitude", "deviation", "gain")
_DEGREES = ("reference", "noise")
PARTS = ("reference", "injection", "disturbance", "noise", "payload")


def scenario_of(case: Case, members: Members, *, dt: float, axes: int, key: Any) -> Scenario:
    """What happens in a case, every part as wide as the members."""
    duration = case.data["duration"]
    parts: dict[str, Any] = {
        part: {
            axis: _total(specs, members, _unit(part), round(duration / dt), dt)
            for axis, specs in case.data.get(part, {}).items()
        }
        for part in PARTS
    }
    if not parts["payload"] and "payload" not in case.data and axes == 1:
        parts["payload"] = {"roll": Step(np.zeros(members.count))}
    given: dict[str, Any] = {name: part or None for name, part in parts.items()}
    made = scenario(duration=duration, dt=dt, axes=axes, key=key, ensemble=members.count, **given)
    wide = lambda x: jnp.broadcast_to(
        x.reshape(x.shape + (1,) * (3 - x.ndim)), (*x.shape[:2], members.count)
    )
    return jax.tree.map(wide, made)


def _unit(part: str) -> float:
    return float(np.radians(1.0)) if part in _DEGREES else 1.0


def _total(
    specs: list[dict[str, Any]], members: Members, unit: float, samples: int, dt: float
) -> Any:
    signals = [_signal(dict(spec), members, unit, samples, dt) for spec in specs]
    total = signals[0]
    for signal in signals[1:]:
        total = total + signal
    return total


def _signal(spec: dict[str, Any], members: Members, unit: float, samples: int, dt: float) -> Any:
    kind = spec.pop("signal")
    options = {k: unit * members.of(v) if k in _BY_MEMBER else v for k, v in spec.items()}
    if kind in _WAVES:
        wave = np.zeros(samples)
        amplitude = options.pop("amplitude")
        made = _WAVES[kind](options, samples * dt, dt).signal[:samples]
        wave[: made.size] = made
        return wave[:, None] * amplitude
    if kind not in _MAKERS:
        raise ValueError(f"no signal {kind!r}: there are {', '.join([*_MAKERS, *_WAVES])}")
    return _MAKERS[kind](**options)


def _sweep(options: dict[str, Any], duration: float, dt: float) -> Excitation:
    """From `low` to `high` Hz, `lasting` seconds from the start, of amplitude 1."""
    low, high, lasting = (options.pop(name) for name in ("low", "high", "lasting"))
    return sweep(
        2 * np.pi * low, 2 * np.pi * high, duration=lasting, sample_rate=1 / dt, amplitude=1.0,
        trim=0.0, **options,
    )  # fmt: skip


def _multisine(options: dict[str, Any], duration: float, dt: float) -> Excitation:
    """Whole periods from the start to the end, of amplitude 1."""
    low, high, period = (options.pop(name) for name in ("low", "high", "period"))
    lines = harmonics(2 * np.pi * low, 2 * np.pi * high, period=period, **options)
    periods = round(duration / period)
    return multisine(lines, period=period, periods=periods, sample_rate=1 / dt, amplitude=1.0)


_WAVES = {"sweep": _sweep, "multisine": _multisine}
