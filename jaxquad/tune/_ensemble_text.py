"""The printed face of an ensemble."""

from typing import Any

import numpy as np

from ._law import Law
from ._law_values import number
from ._variation import FACTORS, plant_inertia


_UNITS = {
    "torque_gain": "times the plant's",
    "told": "times the true inertia",
    "lag": "s",
    "delay": "s",
    "damping": "N m s/rad",
    "stiffness": "N m/rad",
    "coulomb": "N m",
    "noise": "rad, standard deviation",
    "gust": "N m, standard deviation",
    "payload added": "times the plant's inertia, in flight",
    "payload at": "s",
    "payload width": "s",
}


def ensemble_text(ensemble: Any) -> str:
    """What varies, how and in which unit; then what is the same in all members."""
    laws = ensemble.laws
    varies = {name: law for name, law in laws.items() if law.varies}
    same = {name: law for name, law in laws.items() if name not in varies and _says(name, law)}
    kind, axes = type(ensemble.plant).__name__, ensemble.axes
    lines = [f"ensemble of a {kind} of {axes} {'axes' if axes > 1 else 'axis'}"]
    lines += [f"  {ensemble.fitted}"] if ensemble.fitted is not None else []
    lines += [_line(name, law, ensemble) for name, law in varies.items()]
    lines += [_line(name, law, ensemble) for name, law in same.items()]
    lines += [f"  {part}" for part in _hardware(ensemble)]
    return "\n".join(lines)


def _says(name: str, law: Law) -> bool:
    """Whether a fixed quantity is worth a line: a factor of 1 is not."""
    return not (name in FACTORS and np.all(law.support[0] == 1))


def _line(name: str, law: Law, ensemble: Any) -> str:
    unit = _UNITS.get(name, "")
    if name == "inertia":
        unit = f"times {number(plant_inertia(ensemble.plant))} kg m^2"
    alone = ", each axis by itself" if name in ensemble.independent else ""
    return f"  {name:<14} {law.text:<32} {unit}{alone}"


def _hardware(ensemble: Any) -> list[str]:
    corner = f"gusts of {ensemble.gust_corner:.4g} rad/s" if ensemble.gust is not None else None
    sampled = f"{ensemble.sampling} sampling, loop of {1e3 * ensemble.dt:.4g} ms"
    parts = [x for x in (ensemble.drive, ensemble.encoder) if x is not None]
    return [", ".join(x for x in (sampled, corner, *(type(p).__name__ for p in parts)) if x)]
