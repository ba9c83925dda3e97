"""Which member of an ensemble it was."""

from typing import Any

import numpy as np

from ._quantity_text import SHOWN


_NAMED = (
    "itae", "overshoot", "sensitivity_peak", "gain_margin", "gain_reduction", "phase_margin",
    "delay_margin",
)  # fmt: skip


def member_text(certificate: Any, index: int) -> str:
    """The parameters of one member, axes apart by slashes."""
    known = certificate.member(index)
    J = known["inertia"]
    parts = [f"J {_joined(J)} kg m^2"]
    if certificate.nominal is not None:
        parts[0] += f" = {_joined(J / certificate.nominal)} J0"
    if "lag" in known:
        parts.append(f"lag {_joined(1e3 * known['lag'])} ms")
    parts.append(f"KT {_joined(known['torque_gain'])}")
    if np.any(certificate.facts["delay"] > 0):
        parts.append(f"delay {_joined(1e3 * known['delay'])} ms")
    if not np.allclose(known["told"], 1):
        parts.append(f"told {_joined(known['told'])} J")
    return f"member {index}: {', '.join(parts)}"


def worst_lines(certificate: Any) -> list[str]:
    """What is worst in which member; a member that is worst in several is named once."""
    by_member: dict[int, list[str]] = {}
    for quantity in _NAMED:
        if quantity not in certificate.design.by_axis:
            continue
        worst = certificate.design.worst_member(quantity)
        if worst is not None:
            value = certificate.design.of(quantity)[worst]
            text = f"{SHOWN[quantity].title} {SHOWN[quantity].text(value)}"
            by_member.setdefault(worst, []).append(text)
    return [f"{', '.join(what)}: {member_text(certificate, k)}" for k, what in by_member.items()]


def _joined(values: Any) -> str:
    texts = [f"{x:.3g}" for x in np.atleast_1d(values)]
    return texts[0] if len(set(texts)) == 1 else "/".join(texts)
