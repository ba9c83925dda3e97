"""What a log can answer and what not, in plain words, and the flight that would answer the rest."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxquad.excitation import three_two_one_one
from jaxquad.identify import (
    AGREES,
    as_sampled,
    Fit,
    MISFIT,
    model_response,
    Verification,
    WEAK,
    with_values,
)
from jaxquad.plot import COHERENT
from jaxquad.records import Record
from jaxquad.records.firmware import channel_limit, is_setpoint
from jaxquad.spectra import FrequencyResponse

from ._page import Section


Grid = Float[np.ndarray, " frequencies"]
_LOOSE = 0.2  # half of a 95 % interval over the value: CIFER's Cramer-Rao guideline of 20 %
_AIM = 0.8  # coherence that a flight is planned for
_FAINT = 0.2  # coherence below which its estimate says nothing
_LOUDER = 2.0  # times the amplitude that is advised at most: linear ranges are not known
_LONGER = 2.0  # times the duration
_SAMPLES = 25  # in a period of the highest frequency: Tischler & Remple, ch. 5
_CYCLES = 5  # of the lowest frequency: Tischler & Remple, sec. 5.4
_SHORTEST = 20.0  # s, of a sweep
_SHOWS = 0.3  # of the largest share, where a parameter has an effect that no other has
_SAME = 1e-4  # share of a parameter's effect that no other can make, below which none can be seen


class Flight(NamedTuple):
    """What to fly next, and why."""

    what: str
    facts: Mapping[str, str]
    why: Sequence[str]


class _Need(NamedTuple):
    """A band in rad/s to excite, by how many times the accuracy has to grow, and why."""

    low: float
    high: float
    factor: float
    why: str


def answer_section(
    fit: Fit, frf: FrequencyResponse, record: Record | None, checks: Mapping[str, Verification]
) -> Section:
    """Verdict in plain words, lists of what is answered and what not, and the next flight."""
    omega, good, can, cannot = np.asarray(frf.omega), _good(frf), [], []
    answer = f"How {', '.join(frf.output_names)} answers to {', '.join(frf.input_names)}"
    if good.any() and not _is_of_controller(frf):
        error = float(np.median(np.asarray(frf.random_error)[good]))
        can.append(
            f"{answer} from {in_both(*_ends(frf, good))}: to {100 * error:.2g} % of magnitude and "
            f"{np.degrees(error):.2g} deg of phase (median standard error)."
        )
    if fit.verdict.fitted:
        units = fit.parameter_units or [""] * len(fit.names)
        for k, (name, unit) in enumerate(zip(fit.names, units, strict=True)):
            if fit.determined[k] and _reach(fit, k) <= _LOOSE:
                value = f"{fit.values[k]:.4g}{f' {unit}' if unit else ''}"
                can.append(f"{name}: {value} \u00b1 {_two_digits(100 * _reach(fit, k))} % (95 %).")
        for one in fit.combinations:
            can.append(f"{one.name}: {one.value:.4g}{f' {one.unit}' if one.unit else ''}.")
        for k in _loose(fit):
            reach = f"only to \u00b1 {_two_digits(100 * _reach(fit, k))} % (95 %)"
            cannot.append(f"{fit.names[k]}: {reach if fit.determined[k] else 'not by itself'}.")
    if _is_of_controller(frf):
        cannot.append(f"{answer}: the response is that of the controller, -1/C.")
    cannot += [f"The response from {in_both(*band)}: incoherent." for band in poor_bands(frf)]
    cannot.append(f"Anything above {omega[-1] / (2 * np.pi):.3g} Hz: it was not estimated there.")
    if record is not None and not record.reference_names:
        cannot.append(
            "How the closed loop follows its reference, and which part of the response is "
            "feedback: no reference was recorded."
        )
    for name, check in checks.items():
        if check.prediction is not None and check.verdict.kind != AGREES:
            cannot.append(f"What happens in {name}, {check.method}: {check.verdict}.")
        elif check.verdict.kind == AGREES:
            can.append(f"What happens in {name}: predicted, TIC {check.tic:.3f}.")
        else:
            does_not = f"the model does not predict it, TIC {check.tic:.3f}"
            cannot.append(f"What happens in {name}: {does_not}.")
    if not checks:
        cannot.append("Whether the model predicts another flight: no second log was simulated.")
    return {
        "plain": _plain(fit, frf), "can": can or ["Nothing about this vehicle."], "cannot": cannot,
        "flight": next_flight(fit, frf, record, checks),
    }  # fmt: skip


def in_both(low: float, high: float) -> str:
    """A band in Hz, with rad/s behind it."""
    turn = 2 * np.pi
    return f"{low / turn:.3g} to {high / turn:.3g} Hz ({low:.3g} to {high:.3g} rad/s)"


def _plain(fit: Fit, frf: FrequencyResponse) -> str:
    kind = fit.verdict.kind
    if kind == "too few points":
        return "This log excites the vehicle too little: nothing could be fitted to it."
    if _is_of_controller(frf):
        return (
            "This log shows the controller, and not the vehicle: its input answers to its output. "
            "Nothing about the vehicle can be read from it."
        )
    if kind == "no model":
        return (
            "No model of this structure behaves like the vehicle in this log. Its numbers are not "
            "to be used."
        )
    if kind == "no minimum":
        return "The fit found no best values, so that its numbers are not to be used."
    if not fit.identifiable:
        lost = " and ".join(fit.verdict.undetermined)
        return (
            f"The model can behave like the vehicle, but this log alone does not say what {lost} "
            f"{'is' if len(fit.verdict.undetermined) == 1 else 'are one by one'}: other values "
            "explain it as well."
        )
    if fit.chi_squared > MISFIT**2:
        return (
            f"The model follows the vehicle only roughly: it misses the measured response by "
            f"{np.sqrt(fit.chi_squared):.1f} times its random error. The intervals of its "
            "parameters count that."
        )
    good = _good(frf)
    band = f" from {in_both(*_ends(frf, good))}" if good.any() else ""
    return (
        f"The model behaves like the vehicle{band}, to within the random error of the measurement, "
        "and the log determines every free parameter."
    )


def _good(frf: FrequencyResponse) -> Bool[np.ndarray, " frequencies"]:
    return np.all(np.asarray(frf.coherence) >= COHERENT, axis=(1, 2))


def _is_of_controller(frf: FrequencyResponse) -> bool:
    """Whether most coherent points show -1/C, the inverse of the controller."""
    good = _good(frf)
    return bool(2 * np.sum(good & np.any(frf.of_controller, axis=(1, 2))) > np.sum(good))


def _ends(
    frf: FrequencyResponse, where: Bool[np.ndarray, " frequencies"] | slice = slice(None)
) -> tuple[float, float]:
    omega = np.asarray(frf.omega)[where]
    return float(omega[0]), float(omega[-1])


def _two_digits(value: float) -> str:
    return f"{float(f'{value:.2g}'):g}"


def _reach(fit: Fit, k: int) -> float:
    """Half of the 95 % interval over the value."""
    low, high = fit.interval(fit.names[k])
    return float((high - low) / 2 / max(abs(float(fit.values[k])), 1e-300))


def _loose(fit: Fit) -> list[int]:
    """Parameters that are not determined, or known to 20 % only."""
    limits = [bound.name for bound in fit.verdict.bounds]
    loose = [not fit.determined[k] or _reach(fit, k) > _LOOSE for k in range(len(fit.names))]
    return [k for k, is_loose in enumerate(loose) if is_loose and fit.names[k] not in limits]


def poor_bands(frf: FrequencyResponse) -> list[tuple[float, float]]:
    """Bands in rad/s of at least three neighbours whose coherence is below 0.6."""
    omega, bad = np.asarray(frf.omega), ~_good(frf)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], bad, [False]]).astype(int)))
    runs = zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    return [(float(omega[a]), float(omega[b - 1])) for a, b in runs if b - a >= 3]


def next_flight(
    fit: Fit, frf: FrequencyResponse, record: Record | None, checks: Mapping[str, Verification]
) -> Flight:
    """The flight that answers most of what is open, from the fit's own numbers."""
    # A poor band asks for the amplitude that brings its coherence to 0.8.
    omega, poor = np.asarray(frf.omega), []
    for low, high in poor_bands(frf):
        inside = (omega >= low) & (omega <= high)
        level = float(np.median(np.asarray(frf.coherence)[inside]))
        factor = np.sqrt(_AIM / (1 - _AIM) * (1 - level) / max(level, _FAINT))
        text = f"the coherence is {level:.2g} from {in_both(low, high)}; {_AIM:g} is the aim"
        poor.append(_Need(low, high, float(factor), text))
    usable = fit.verdict.kind in ("identifiable", "not identifiable")
    needs = _needs_of_parameters(fit, frf) if usable else poor
    if _is_of_controller(frf):
        why = "the controller moved the input of this log; record what excites the axis, and name "
        needs = [_Need(*_ends(frf), _LOUDER, f"{why}it as the reference")]
    if not fit.identifiable and not needs and not fit.verdict.remedies:
        low, high = _ends(frf)
        why = "the band of this record does not determine the model"
        needs = [_Need(low / 2, 2 * high, _LOUDER, why)]
    highest = _highest(frf, record)
    needs = [need for need in needs if need.low < highest or not fit.identifiable]
    if needs and record is not None and _is_own_command(record):
        return Flight(_EXCITE, {}, [*dict.fromkeys(_sentence(need.why) for need in needs)])
    if needs:
        return _sweep([*needs, *poor], frf, record)
    if not fit.identifiable and fit.verdict.remedies:
        what = "No further flight of the same kind helps. " + _sentence(fit.verdict.remedies[0])
        return Flight(what, {}, [*map(_sentence, fit.verdict.remedies[1:])])
    wished = [f"Only if you need it: {_sweep([need], frf, record).what}" for need in poor]
    passed = lambda c: c.verdict.kind == AGREES or (c.prediction and c.verdict.kind == WEAK)
    failed = [name for name, check in checks.items() if not passed(check)]
    if failed:
        what = (
            f"None before it is clear why the model does not predict {' and '.join(failed)}: "
            "compare loading, battery and flight state of the two flights, then identify both "
            "together."
        )
        return Flight(what, {}, wished)
    if checks:
        what = "None for this model: tune with it, then fly the tuned gains."
        return Flight(what, {}, [*(_sentence(need.why) for need in poor), *wished])
    # A 3-2-1-1 whose spectrum peaks in the middle of the band.
    good = _good(frf)
    low, high = _ends(frf, good) if good.any() else _ends(frf)
    unit = three_two_one_one(width=1.0, amplitude=1.0, sample_rate=20.0)
    width = float(np.sqrt(unit.omega_min * unit.omega_max / (low * high)))
    source, peak = _source(frf, record)
    _, text = _amplitude(source, peak, record, 1.0)
    facts = {
        "axis": f"{', '.join(frf.output_names)}, by {source}",
        "pulses": f"3-2-1-1, the shortest pulse {width:.2g} s, so that it peaks at "
        f"{np.sqrt(low * high) / (2 * np.pi):.2g} Hz",
        "amplitude": text,
        "seconds": f"{7 * width + 4:.2g}, rest before and after included",
    }
    what = (
        f"A 3-2-1-1 on the channel {source} with a shortest pulse of {width:.2g} s, to verify the "
        "model on a flight that it was not fitted to."
    )
    why = "The log determines this model: what is missing is a check."
    return Flight(what, facts, [why, *wished])


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _needs_of_parameters(fit: Fit, frf: FrequencyResponse) -> list[_Need]:
    """A loose parameter asks for the band in which it acts as no other does, and for an accuracy
    that grows with amplitude and with the root of time."""
    loose = _loose(fit)
    if not loose:
        return []
    omega, unshared = _unshared_effects(fit, frf)
    low_end, high_end = _ends(frf)
    needs = []
    for k in loose:
        if not unshared[k].any():
            continue
        # The band in which it shows leaves the measured one on the side of its peak only.
        peak = float(omega[unshared[k].argmax()])
        shows = omega[unshared[k] >= np.sqrt(_SHOWS) * unshared[k].max()]
        low, high = float(shows[0]), float(shows[-1])
        if peak > np.sqrt(low_end * high_end):
            low = max(low_end, low)
        else:
            high = min(high_end, high)
        by_noise = float(np.diff(fit.interval(fit.names[k], model_error=False))[0] / 2)
        by_noise /= max(abs(float(fit.values[k])), 1e-300)
        factor = by_noise / _LOOSE if np.isfinite(by_noise) else np.inf
        reach = f"is known to \u00b1 {_two_digits(100 * _reach(fit, k))} %"
        if not fit.determined[k]:
            reach = "is not determined"
        text = f"the parameter {fit.names[k]} {reach}, and shows itself from {in_both(low, high)}"
        needs.append(_Need(low, high, max(factor, 1.0), text))
    return needs


_STEP = 1e-4  # relative, of a parameter
_NONE = 1e-3  # of a parameter's start, below which it has run to zero


def _unshared_effects(
    fit: Fit, frf: FrequencyResponse
) -> tuple[Grid, Float[np.ndarray, "parameters frequencies"]]:
    """What each parameter does to ln G that no other does, from half to twice the measured band.

    Zero where the others make the same. What ran to zero, where it does nothing, is at its start.
    """
    low, high = _ends(frf)
    omega = np.geomspace(low / 2, high * 2, 200)
    places = fit.parameters.places[: len(fit.names)]
    values = np.asarray(fit.values, float)
    start = np.asarray(fit.parameters.scale)[: values.size]
    values = np.where(np.abs(values) < _NONE * np.abs(start), start, values)

    def response(moved: Float[np.ndarray, " parameters"]) -> np.ndarray:
        model = with_values(fit.model, places, moved)
        return model_response(as_sampled(model, frf), omega).reshape(omega.size, -1)

    columns = []
    for step in _STEP * np.diag(np.abs(values)):
        change = np.log(response(values + step) / response(values - step)) / (2 * _STEP)
        columns.append(np.stack([change.real, change.imag]).ravel())
    effects = np.array(columns).T
    rests = effects.copy()
    for k in range(len(values)):
        others = np.delete(effects, k, axis=1)
        rests[:, k] -= others @ np.linalg.lstsq(others, effects[:, k], rcond=None)[0]
    sizes = [np.linalg.norm(part, axis=0) for part in (rests, effects)]
    rests[:, sizes[0] < _SAME * sizes[1]] = 0.0
    rests = rests.reshape(2, omega.size, -1, len(values))
    per_second = np.sqrt(omega / omega[0])  # high frequencies take less time
    return omega, np.sqrt(np.sum(rests**2, axis=(0, 2))).T * per_second


def _sweep(needs: Sequence[_Need], frf: FrequencyResponse, record: Record | None) -> Flight:
    measured = _ends(frf)
    low = min(need.low for need in needs)
    high = min(max(need.high for need in needs), _highest(frf, record))
    low, high = min(low, measured[1] / 10), max(high, measured[0] * 10)
    high = float(f"{high / (2 * np.pi):.3g}")  # Hz, as it is printed
    low = min(float(f"{low / (2 * np.pi):.3g}"), high / 10)  # at least a decade
    factor = max(need.factor for need in needs)
    source, peak = _source(frf, record)
    louder = float(np.clip(factor, 1.0, _loudest(source, peak)))
    longer = min(factor / louder, _LONGER**0.5) ** 2
    now = 0.0 if record is None else record.duration
    seconds = max(now * longer, _CYCLES / low, _SHORTEST)
    seconds = float(np.ceil(seconds / 5) * 5)
    amplitude, text = _amplitude(source, peak, record, louder)
    facts = {
        "axis": f"{', '.join(frf.output_names)}, by {source}",
        "frequencies": f"sweep from {in_both(2 * np.pi * low, 2 * np.pi * high)}",
        "amplitude": text,
        "seconds": f"{seconds:g}" + (f" (now {now:.3g})" if now else ""),
    }
    if record is not None:
        rate = np.ceil(max(record.sample_rate, _SAMPLES * high))
        facts["signal"] = (
            f"jaxquad design sweep --band {low:.6g} {high:g} --rate {rate:.0f} "
            f"--amplitude {amplitude} --duration {seconds:g}"
        )
    what = f"Sweep the channel {source} from {_two_digits(low)} to {_two_digits(high)} Hz, "
    what += f"{text.split(' (')[0]}, for {seconds:g} s."
    return Flight(what, facts, [*dict.fromkeys(_sentence(need.why) for need in needs)])


def _highest(frf: FrequencyResponse, record: Record | None) -> float:
    """In rad/s, to which a sweep can be flown and logged: that of the log's rate, or measured."""
    if record is None:
        return np.inf
    good = _good(frf)
    measured = _ends(frf, good)[1] if good.any() else 0.0
    return max(2 * np.pi * record.sample_rate / _SAMPLES, measured)


_EXCITE = (
    "A chirp of the rate set-point on this axis, or strong and quick sticks in acro, for 20 s, "
    "with the set-point logged: the command of an autopilot's loop cannot be swept itself. jaxquad "
    "autopilot says how to fly it with this firmware."
)


def _is_own_command(record: Record) -> bool:
    """Whether the loop of an autopilot alone moved the input."""
    return not record.reference_names and channel_limit(record.input_names[0]) is not None


def _source(frf: FrequencyResponse, record: Record | None) -> tuple[str, float]:
    """The channel to excite, and its amplitude in this record: half of its range."""
    if record is None:
        return frf.input_names[0], np.nan
    name = record.reference_names[0] if record.reference_names else record.input_names[0]
    return name, float(np.ptp(record.channel(name)) / 2)


def _loudest(name: str, peak: float) -> float:
    """By how much an amplitude may grow: to the end of a stick or a command; how far a rate
    set-point can go depends on the pilot's rates, so that stays."""
    limit = peak if is_setpoint(name) else channel_limit(name)
    return _LOUDER if limit is None or not peak > 0 else float(np.clip(limit / peak, 1.0, _LOUDER))


def _amplitude(name: str, peak: float, record: Record | None, louder: float) -> tuple[str, str]:
    """As a number and in words: that of the record, times `louder`."""
    if record is None:
        return "", f"{louder:.2g} times the amplitude of this record"
    number, unit = _two_digits(louder * peak), record.unit(name)
    limit = channel_limit(name)
    if limit is not None and float(number) > limit:  # a record may go beyond, as a sum of terms
        number = f"{limit:g}"
    text = f"amplitude {number}{f' {unit}' if unit else ''}"
    if louder > 1:
        return number, f"{text} ({louder:.2g} times this record's; less if the motors saturate)"
    return number, f"{text} (as in this record)"
