"""The filters that a firmware could have: the options of each, and what they do on every axis."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from ._filters import Filter, FilterChain
from ._firmware import cutoff_of, FilterChoice, FilterOption, firmware_named, LowPass
from ._gyro_noise import GyroNoise
from ._law import RateLoop
from ._parameters import find_parameter, flown_loop, gains_of, store_parameters
from ._rate_loops import Filters, Frequencies, gyro_chain_response, law_paths, Paths, Response
from ._stages import SharedChange


Picks = Int[np.ndarray, "designs choices"]
_STEPS = 8  # of a cutoff, to either side of the one that flew
_HIGHEST = 0.45  # of the rate at which a filter runs
_WIDTHS = (0.1, 0.2)  # half of a notch, of its centre
_SLOW = 2 * np.pi * 5.0  # rad/s, where delays are compared


def filter_choices(
    firmware: str, values: Mapping[str, str], version: Sequence[int] = (), *, axis: int = 0,
    throttle: float = 0.3, change: float = 3.0, line_hz: float | None = None,
) -> tuple[FilterChoice, ...]:  # fmt: skip
    """The low-passes of gyro and D term that are on, and a notch at a line of the gyro's noise.

    Their kinds stay. A dynamic low-pass is moved as a whole, its lowest and its highest cutoff by
    one factor. A notch, narrow or wide, is offered where one of the static notches is off.

    **Arguments:**

    - `firmware`, `values`, `version`, `throttle`: as in `flown_loop`.
    - `axis`: 0, 1 or 2 for roll, pitch or yaw, whose own filters are offered.
    - `change`: factor by which a cutoff may rise or fall, within its documented range.
    - `line_hz`: of the line; None offers no notch.
    """
    kind, choices = firmware_named(firmware), []
    loop = flown_loop(firmware, values, version, throttle=throttle)
    for low_pass in kind.low_passes(loop, values, version, axis, throttle):
        choices.append(_low_pass_choice(firmware, low_pass, change))
    flown = zip(kind.notches, kind.flown_notches(values), strict=False)
    free = [(names, second) for names, (centre, second) in flown if centre == 0]
    if line_hz is not None and free:
        line, rate_hz = float(np.rint(line_hz)), kind.notch_rate_hz(loop)
        names, second = free[0]
        options = [FilterOption(dict(zip(names, (0.0, second), strict=True)), None)]
        for half_width in _WIDTHS if line < _HIGHEST * rate_hz else ():
            pair = line, kind.notch_width(line, half_width)
            options.append(FilterOption(dict(zip(names, pair, strict=True)), kind.notch(*pair)))
        choices.append(FilterChoice("gyro", True, rate_hz, tuple(options), 0))
    return tuple(choice for choice in choices if len(choice.options) > 1)


def _low_pass_choice(firmware: str, low_pass: LowPass, change: float) -> FilterChoice:
    """Cutoffs that the firmware can store: whole numbers, or three digits in single precision."""
    stage, flown, filter, rate_hz, shared = low_pass
    cutoff, reach = cutoff_of(filter), np.linspace(0.0, np.log(change), _STEPS + 1)[1:]
    options: dict[tuple[float, ...], FilterOption] = {}
    for factor in [*np.exp(-reach[::-1]), 1.0, *np.exp(reach)]:
        if factor == 1:
            options[tuple(flown.values())] = FilterOption(dict(flown), filter)
            continue
        wanted = {name: float(f"{factor * value:.3g}") for name, value in flown.items()}
        stored = store_parameters(firmware, wanted)
        scaled = sum(stored.values()) / sum(flown.values()) * cutoff
        rows = {find_parameter(firmware, name): value for name, value in stored.items()}
        inside = all(max(row.low, 1.0) <= value <= row.high for row, value in rows.items())
        if inside and scaled < _HIGHEST * rate_hz:
            assert dataclasses.is_dataclass(filter) and not isinstance(filter, type)
            moved = dataclasses.replace(filter, **{"cutoff_hz": scaled})
            assert isinstance(moved, Filter)
            options[tuple(stored.values())] = FilterOption(dict(stored), moved)
    at = [*options].index(tuple(flown.values()))
    return FilterChoice(stage, shared, rate_hz, tuple(options.values()), at)


class _OtherAxis(NamedTuple):
    """What an axis that is not tuned makes of its gyro's noise."""

    slow: Response  # by P and I
    quick: Response  # by D
    noise: Frequencies


def _other_axes(law: RateLoop, noise: GyroNoise, omega: Frequencies) -> list[_OtherAxis]:
    """Those whose gyro is in the log, under a law; behind the gyro's filters of that law."""
    others = []
    for k, density in noise.others.items():
        gains, (back, _) = gains_of(law, k), law_paths(law, k, omega)
        power = noise.powers(density, omega)
        others.append(_OtherAxis(gains[:2] @ back[:2], gains[2] * back[2], power))
    return others


class FilterBank:
    """The options of all free filters, as their responses over those that flew."""

    def __init__(
        self, choices: Sequence[FilterChoice], law: RateLoop, noise: GyroNoise, omega: Frequencies
    ):
        self.choices, self.measured = tuple(choices), omega / (2 * np.pi) <= noise.known_hz
        self.flown = np.array([choice.flown for choice in choices])  # the picks of what flew
        self.counts = np.array([len(choice.options) for choice in choices])
        self._others = _other_axes(law, noise, omega)
        low, self._ratios, self._delays = int(np.searchsorted(omega, _SLOW)), [], []
        for choice in self.choices:
            responses = np.stack(
                [
                    np.ones(omega.size, complex) if option.filter is None
                    else FilterChain((option.filter,), choice.rate_hz).response(omega / (2 * np.pi))
                    for option in choice.options
                ]
            )  # fmt: skip
            self._ratios.append(responses / responses[choice.flown])
            self._delays.append(-np.angle(self._ratios[-1][:, low]) / omega[low])

    def filters(self, picks: Picks) -> Filters:
        """The responses of each design's filters over those that flew."""
        ones = np.ones((len(picks), self.measured.size), complex)
        responses = {"gyro": ones, "derivative": ones}
        for k, choice in enumerate(self.choices):
            responses[choice.stage] = responses[choice.stage] * self._ratios[k][picks[:, k]]
        return Filters(responses["gyro"], responses["derivative"])

    def beyond(self, picks: Picks) -> Float[np.ndarray, " designs"]:
        """How far the other axes get, over what is allowed: their delay may not grow."""
        late = {"gyro": np.zeros(len(picks)), "derivative": np.zeros(len(picks))}
        for k, choice in enumerate(self.choices):
            if choice.shared:
                late[choice.stage] = late[choice.stage] + self._delays[k][picks[:, k]]
        worst = np.maximum(late["gyro"], late["gyro"] + late["derivative"])
        return np.where(worst > 1e-7, 1 + 1e3 * worst, 0.0)

    def other_noise(self, filters: Filters) -> Float[np.ndarray, " designs"]:
        """Of the other axes' commands, over what flew: rms, and of each frequency not known."""
        if not all(choice.shared for choice in self.choices):  # those of the tuned axis' D term
            filters = filters._replace(derivative=np.ones_like(filters.derivative))
        growth = [np.zeros(len(filters.gyro))]
        for axis in self._others:
            through = (axis.slow + axis.quick * filters.derivative) * filters.gyro
            growth.append(noise_growth(through, axis.slow + axis.quick, axis.noise, self.measured))
        return np.max(growth, axis=0)

    def parameters(self, picks: Int[np.ndarray, " choices"]) -> dict[str, float]:
        """The parameters of one design's filters that differ from what flew."""
        changed: dict[str, float] = {}
        for choice, pick in zip(self.choices, picks, strict=True):
            if pick != choice.flown:
                changed |= choice.options[pick].parameters
        return changed


def noise_growth(
    through: Paths, flown: Complex[np.ndarray, " frequencies"], noise: Frequencies,
    measured: np.ndarray,
) -> Float[np.ndarray, " designs"]:  # fmt: skip
    """The command's noise over what flew: its rms, and the gain where the noise is not known."""
    before = np.abs(flown) ** 2
    power = np.abs(through) ** 2
    rms = np.sqrt(power @ noise / max(float(before @ noise), 1e-300))
    if measured.all():
        return rms
    unseen = np.sqrt((power / before)[:, ~measured].max(axis=1))
    return np.maximum(rms, unseen)


def shared_change(
    law: RateLoop, changed: RateLoop, noise: GyroNoise, omega: Frequencies, axis: int
) -> SharedChange:
    """By the laws as they are built, not by the ratios of a search."""
    measured, growth = omega / (2 * np.pi) <= noise.known_hz, [0.0]
    ratio = gyro_chain_response(changed, omega) / gyro_chain_response(law, omega)
    both = zip(_other_axes(law, noise, omega), _other_axes(changed, noise, omega), strict=True)
    for before, after in both:
        through, flown = (after.slow + after.quick) * ratio, before.slow + before.quick
        growth.append(float(noise_growth(through[None], flown, before.noise, measured)[0]))
    at, phases = np.array([_SLOW]), []
    for one in (law, changed):
        gyro, back = gyro_chain_response(one, at), law_paths(one, (axis + 1) % 3, at)[0]
        phases.append((np.angle(gyro)[0], np.angle(gyro * back[2])[0]))
    (gyro, slope), (later, steeper) = phases
    late = tuple(-1e3 * (b - a) / _SLOW for a, b in ((gyro, later), (slope, steeper)))
    return SharedChange((late[0], late[1]), max(growth))
