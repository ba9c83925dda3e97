"""A certificate for print. The first line is the verdict."""

from typing import Any

import numpy as np

from ._judged import LINEAR
from ._member_text import member_text, worst_lines
from ._quantity_text import SHOWN
from ._row import Row


# Title, unit, quantity and statistic of each line of the table.
_LINES = (
    ("ITAE, deg s^2", "mean", "itae", "mean"),
    ("", "p95", "itae", "p95"),
    ("", "worst", "itae", "worst"),
    ("overshoot, %", "mean", "overshoot", "mean"),
    ("", "worst", "overshoot", "worst"),
    ("slowest pole, 1/s", "worst", "abscissa", "worst"),
    ("Ms", "mean", "sensitivity_peak", "mean"),
    ("", "worst", "sensitivity_peak", "worst"),
    ("gain margin, dB", "up, worst", "gain_margin", "worst"),
    ("", "down, worst", "gain_reduction", "worst"),
    ("phase margin, deg", "worst", "phase_margin", "worst"),
    ("delay margin, ms", "worst", "delay_margin", "worst"),
    ("activity, u^2/s", "mean", "activity_rate", "mean"),
    ("saturated, %", "mean", "saturation_share", "mean"),
    ("disturbance err., N m", "mean", "disturbance_rmse", "mean"),
)  # fmt: skip
_FIRST = 34


def described(certificate: Any) -> str:
    """The verdict, the limits, the designs side by side, the worst members, and the remarks."""
    lines = [verdict(certificate)]
    lines += [f"  {distance}" for distance in certificate.distances]
    lines += _table(certificate.rows)
    lines += [f"  worst members of {certificate.name}:"]
    lines += [f"    {line}" for line in worst_lines(certificate)]
    lines += [f"  ! {remark}" for remark in certificate.remarks]
    return "\n".join([*lines, f"  {_provenance(certificate.provenance)}"])


def verdict(certificate: Any) -> str:
    """One line: whether the certificate holds, or what fails first and by how much."""
    on = f"{certificate.members} {'fresh ' * certificate.provenance['fresh']}members"
    if certificate.holds:
        count = len(certificate.distances)
        met = ("", ", the limit is met")[count] if count < 2 else f", all {count} limits are met"
        return f"CERTIFICATE HOLDS on {on}: none is unstable{_proven(certificate)}{met}"
    first, *others = _failures(certificate)
    more = f"; and {len(others)} more" if others else ""
    return f"CERTIFICATE FAILS on {on}: {first}{more}"


def _proven(certificate: Any) -> str:
    bound = certificate.rows[certificate.name].unstable_at_most
    return (
        "" if bound is None else f" (proven: at most {100 * bound:.2g} % of all, 95 % confidence)"
    )


def _failures(certificate: Any) -> list[str]:
    design, found = certificate.design, []
    if design.unstable is None:
        found.append("the controller has no linear form, so its stability is not known")
    elif design.unstable.any():
        found.append(_count(design.unstable, "linearly unstable", certificate))
    if design.diverged.any():
        found.append(_count(design.diverged, "diverged in flight", certificate))
    if design.runaway:
        found.append(design.runaway)
    missed = [distance for distance in certificate.distances if not distance.met]
    for distance in sorted(missed, key=lambda d: -np.inf if np.isnan(d.percent) else d.percent):
        where = "" if distance.member is None else member_text(certificate, distance.member)
        found.append(f"{distance}{f' ({where})' if where else ''}")
    return found


def _count(which: np.ndarray, what: str, certificate: Any) -> str:
    count, first = int(which.sum()), int(np.argmax(which))
    worst = certificate.design.worst_member("abscissa")  # None without a linear form
    where = member_text(certificate, first if worst is None or not which[worst] else worst)
    return f"{count} of {which.size} ({count / which.size:.1%}) {what} ({where})"


def _table(rows: dict[str, Row]) -> list[str]:
    widths = {name: max(len(name), 7) + 3 for name in rows}
    head = " " * (_FIRST + 2) + "".join(f"{name:>{widths[name]}}" for name in rows)
    lines = [head, *_counts(rows, widths)]
    for title, which, quantity, statistic in _LINES:
        cells = "".join(
            f"{_cell(row, quantity, statistic):>{widths[name]}}" for name, row in rows.items()
        )
        lines.append(f"  {title:<22}{which:<12}{cells}")
    return lines


def _counts(rows: dict[str, Row], widths: dict[str, int]) -> list[str]:
    share = lambda x: "n/a" if x is None else f"{100 * x:.3g}"
    values = {
        ("unstable, %", "found"): [
            None if row.unstable is None else row.unstable / row.members for row in rows.values()
        ],
        ("", "at most"): [row.unstable_at_most for row in rows.values()],
        ("diverged, %", ""): [row.diverged / row.members for row in rows.values()],
    }
    return [
        f"  {title:<22}{which:<12}"
        + "".join(f"{share(x):>{w}}" for x, w in zip(numbers, widths.values(), strict=True))
        for (title, which), numbers in values.items()
    ]


def _cell(row: Row, quantity: str, statistic: str) -> str:
    unknown = quantity in LINEAR and quantity != "abscissa" and row.unstable
    if unknown or quantity not in row.statistics:
        return "n/a"
    return SHOWN[quantity].text(getattr(row.statistics[quantity], statistic), unit=False)


def _provenance(known: dict[str, Any]) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in known["versions"].items())
    return f"{known['members']} members, {known['sampling']}, key {known['key']}; {versions}"
