from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxquad.spectra import FrequencyResponse


_COHERENT = 0.6
_LINES = ["-", "--", "-.", ":"]
_MARKS = ["x", "+", "^", "s"]
_DB = 20 / np.log(10)


def bode(
    frf: FrequencyResponse,
    models: Mapping[str, Any] | None = None,
    *,
    others: Mapping[str, FrequencyResponse] | None = None,
    pair: tuple[str, str] | None = None,
    title: str = "",
) -> Any:
    """Magnitude, phase and coherence of a measured response, with its 95 % band, beside models.

    `models` by name have `frequency_response`; `others` are further estimates of the same response.
    `pair` is (output, input), by default the first of each. Points whose coherence is below 0.6
    are faint. Returns a `matplotlib.figure.Figure`. Source: the paper's Figure 5.
    """
    from matplotlib.figure import Figure

    o, i = _position(frf, pair)
    figure = Figure(figsize=(6.5, 7.0), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True, height_ratios=[3, 3, 1.6])
    _measured(axes, frf, o, i)
    for k, (name, other) in enumerate((others or {}).items()):
        _other(axes, frf, other, o, i, name, _MARKS[k % len(_MARKS)])
    for k, (name, model) in enumerate((models or {}).items()):
        _model(axes, frf, model, o, i, name, _LINES[k % len(_LINES)])
    _label(figure, axes, frf, o, i, title)
    return figure


def _position(frf: FrequencyResponse, pair: tuple[str, str] | None) -> tuple[int, int]:
    if pair is None:
        return 0, 0
    output, source = pair
    if output not in frf.output_names or source not in frf.input_names:
        raise ValueError(
            f"no response {pair}: outputs are {frf.output_names}, inputs {frf.input_names}"
        )
    return frf.output_names.index(output), frf.input_names.index(source)


def _measured(axes: Any, frf: FrequencyResponse, o: int, i: int) -> None:
    omega, error = np.asarray(frf.omega), 1.96 * np.asarray(frf.random_error)[:, o, i]
    good = np.asarray(frf.coherence)[:, o, i] >= _COHERENT
    for axis, level, width in (
        (axes[0], frf.magnitude_db[:, o, i], _DB * error),
        (axes[1], _phase(frf, o, i), np.degrees(error)),
    ):
        low, high = level - width, level + width
        shown = np.where(good, 1.0, np.nan)
        axis.fill_between(omega, low * shown, high * shown, color="0.8", lw=0, label="95 % band")
        axis.plot(omega[good], level[good], "o", ms=3.5, color="0.15", label=f"{frf.method}")
        axis.plot(omega[~good], level[~good], "o", ms=3, mfc="none", mec="0.7", label="unused")
    axes[2].plot(omega, np.asarray(frf.coherence)[:, o, i], "o-", ms=2.5, lw=0.8, color="0.15")


def _other(
    axes: Any,
    frf: FrequencyResponse,
    other: FrequencyResponse,
    o: int,
    i: int,
    name: str,
    mark: str,
) -> None:
    omega, good = np.asarray(other.omega), np.asarray(other.coherence)[:, o, i] >= _COHERENT
    phase = _phase(other, o, i)
    phase = phase - 360 * np.round(_middle(phase, good) / 360 - _middle(_phase(frf, o, i)) / 360)
    style = dict(ls="none", marker=mark, ms=5, mew=0.9, color="tab:red", label=name)
    axes[0].plot(omega[good], other.magnitude_db[good, o, i], **style)
    axes[1].plot(omega[good], phase[good], **style)
    coherence = np.asarray(other.coherence)[:, o, i]
    axes[2].plot(omega, coherence, ls=":", marker=mark, ms=3, lw=0.8, color="tab:red")


def _model(
    axes: Any, frf: FrequencyResponse, model: Any, o: int, i: int, name: str, line: str
) -> None:
    omega = np.geomspace(float(frf.omega[0]), float(frf.omega[-1]), 300)
    response = np.asarray(_response(model, jnp.asarray(omega)))[:, o, i]
    phase = np.degrees(np.unwrap(np.angle(response)))
    measured = np.interp(omega, np.asarray(frf.omega), _phase(frf, o, i))
    phase = phase - 360 * np.round(np.median(phase - measured) / 360)
    style = dict(ls=line, lw=1.6, color="tab:blue", label=name)
    axes[0].plot(omega, 20 * np.log10(np.abs(response)), **style)
    axes[1].plot(omega, phase, **style)


@eqx.filter_jit
def _response(
    model: Any, omega: Float[Array, " frequencies"]
) -> Complex[Array, "frequencies outputs inputs"]:
    return model.frequency_response(omega)


def _phase(frf: FrequencyResponse, o: int, i: int) -> Float[np.ndarray, " frequencies"]:
    """Unwrapped from the most coherent frequency outwards, so that noise cannot shift the rest."""
    wrapped = np.angle(np.asarray(frf.response)[:, o, i])
    best = int(np.argmax(np.asarray(frf.coherence)[:, o, i]))
    up = np.unwrap(wrapped[best:])
    down = np.unwrap(wrapped[: best + 1][::-1])[::-1]
    phase = np.degrees(np.concatenate([down[:-1], up]))
    return phase - 360 * np.round((phase[best] + 180) / 360)


def _middle(phase: Float[np.ndarray, " frequencies"], good: Any = slice(None)) -> float:
    return float(np.median(phase[good])) if np.size(phase[good]) else 0.0


def _label(figure: Any, axes: Any, frf: FrequencyResponse, o: int, i: int, title: str) -> None:
    name = f"{frf.output_names[o]} / {frf.input_names[i]}"
    for axis, text in zip(axes, (f"|{name}|, dB", "phase, deg", "coherence"), strict=True):
        axis.set_ylabel(text)
        axis.grid(True, which="both", color="0.9", lw=0.5)
    axes[2].axhline(_COHERENT, color="0.4", lw=0.8, ls="--")
    axes[2].text(0.995, _COHERENT + 0.02, "0.6", transform=axes[2].get_yaxis_transform(),
                 ha="right", va="bottom", fontsize=8, color="0.3")  # fmt: skip
    axes[2].set_ylim(0, 1.02)
    axes[2].set_xscale("log")
    axes[2].xaxis.set_major_formatter("{x:g}")
    axes[2].set_xlabel("frequency, rad/s")
    hertz = axes[0].secondary_xaxis("top", functions=(_to_hertz, _to_rad))
    hertz.set_xlabel("frequency, Hz")
    hertz.xaxis.set_major_formatter("{x:g}")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=min(len(labels), 5), fontsize=9
    )
    if title:
        figure.suptitle(title)


def _to_hertz(omega: Any) -> Any:
    return omega / (2 * np.pi)


def _to_rad(hertz: Any) -> Any:
    return hertz * 2 * np.pi
