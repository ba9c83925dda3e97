"""Numbers for print: radians as degrees, ratios as dB, what does not exist as a dash."""

import numpy as np
from jaxtyping import Array, Float


def shown(
    value: Float[Array, ""] | float,
    error: Float[Array, ""] | float | None,
    unit: str,
    scale: float = 1.0,
) -> str:
    """`value` times `scale` with its standard error."""
    if not np.isfinite(value):
        return "-"
    doubt = "" if error is None else f" +- {float(error) * scale:.2g}"
    return f"{float(value) * scale:.4g}{doubt} {unit}"


def degrees(value: Float[Array, ""] | float, error: Float[Array, ""] | float | None) -> str:
    """An angle in rad as degrees."""
    return shown(value, error, "deg", float(np.degrees(1.0)))


def decibels(value: Float[Array, ""] | float, error: Float[Array, ""] | float | None) -> str:
    """A ratio in dB."""
    if not np.isfinite(value):
        return "-"
    scale = 20 / np.log(10)
    relative = None if error is None else np.asarray(error) / np.asarray(value)
    doubt = "" if relative is None else f" +- {scale * float(relative):.2g}"
    return f"{scale * np.log(float(value)):.4g}{doubt} dB"


def lines(rows: list[tuple[str, str]], remarks: list[str]) -> str:
    """Names and numbers in two columns, then the remarks."""
    width = max(len(name) for name, _ in rows)
    table = [f"  {name:<{width}}  {text}" for name, text in rows]
    return "\n".join(table + [f"  ! {remark}" for remark in remarks])
