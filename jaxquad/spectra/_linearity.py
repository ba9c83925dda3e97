"""Signs in the residual of any excitation that a plant is not linear, or not constant.

A static nonlinearity in front of the plant adds f(u) to its input, a plant that changes adds
(t - mean) u. What the local linear model does not explain of these is looked for in the residual,
both taken back through the identified response to the plant's input.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int, Real

from jaxquad.records import Record

from ._checks import in_hertz
from ._harmonics import fast_length, interpolated, local_mean, remarks_on_harmonics, tones_of
from ._remarks import Remark


_COHERENT, _FEWEST = 0.6, 8  # of points between which the response is interpolated
_CLEAR = 6.0  # standard errors from which a remark is made; linear records reached 3.3 and 4.4
_SMALLEST = 0.05  # change of the gain from which a remark is made
_DISTINCT_STATIC, _DISTINCT_CHANGE = 0.005, 0.1  # share of a signal that no linear model explains
_POWERS = 3  # coefficients of what is smooth over a block
_MOVED = 32  # bins over which the response of an input to the references is smooth
_PER_COLUMN = 8  # excited bins of a block for each coefficient of the response
_SPARE = 6  # bins of a block beyond all coefficients
_EXCITED = 0.1  # of the mean power nearby
_FLOOR = 1e-20  # of the power of what is looked for: below it lies rounding
_SMOOTH, _ALONE = 0.1, 1e-6  # in ln(omega); of its square, to the scatter of points nearby
_MORE = 4.0  # standard errors by which a second signal must add to the first
_SMALL, _LARGE, _NEGATIVE = 20, 95, 5  # percentiles of the commands at which gains are compared
_POWER = 1, 2, 1  # of x in the gains of v |v|, v^3, v^2, with x = |v|, |v|, v
_DEPENDENT = 1e-3  # smallest singular value: dlnG/dln(omega) of an integrator is constant
_PLACES = 64  # samples compared first
_EXACT = 1e-9  # of the largest value

Method = Literal["direct", "joint"]
Grid = Float[np.ndarray, " frequencies"]
Samples = Float[np.ndarray, " samples"]
Columns = Complex[np.ndarray, "bins columns"]
Responses = Complex[np.ndarray, "frequencies outputs inputs"]


def remarks_on_linearity(
    records: Sequence[Record],
    omega: Grid,
    response: Responses,
    coherence: Float[np.ndarray, "frequencies outputs inputs"],
    method: Method,
) -> tuple[Remark, ...]:
    """Remarks on pairs whose residual shows that the plant is not linear, or not constant.

    Of a sweep these are its harmonics: there, time is no other signal than frequency.
    """
    remarks, measured = (), (omega, response, coherence)
    for i in range(len(records[0].input_names)):
        tones = tones_of(records, i, method)
        if tones is None:
            remarks += _remarks_on_added(records, i, *measured, method)
        else:
            remarks += remarks_on_harmonics(records, tones, i, *measured)
    return remarks


def _remarks_on_added(
    records: Sequence[Record],
    i: int,
    omega: Grid,
    response: Responses,
    coherence: Float[np.ndarray, "frequencies outputs inputs"],
    method: Method,
) -> tuple[Remark, ...]:
    """Remarks on outputs whose residual holds a function of input `i`, or this times time."""
    remarks, first = [], records[0]
    usable = np.isfinite(response).all(axis=2) & (coherence[:, :, i] >= _COHERENT)
    outputs = [o for o in range(usable.shape[1]) if np.sum(usable[:, o]) >= _FEWEST]
    if not outputs:
        return ()
    scale = float(np.sqrt(np.mean([np.var(record.inputs[:, i]) for record in records])))
    spectra = [_Spectra.of(record, i, method, scale) for record in records]
    u = np.concatenate([part.input for part in spectra])
    for o in outputs:
        pair, used = (first.output_names[o], first.input_names[i]), usable[:, o]
        left = _left_over(spectra, omega[used], response[used, o], (o, i))
        if left is None:
            continue
        static, change = _static(left, u / scale), _change(left, omega[used], method)
        if static:  # `Periodic` suits an excitation that repeats
            moving = [x.inputs if method == "direct" else x.references for x in records]
            period = period_of(moving)
            if period:
                few = min(record.samples for record in records) // period <= 2
                settings = f"{period * first.dt:.8g}{', discard=0' if few else ''}"
                static += (
                    f". The excitation repeats: jq.spectra.Periodic({settings}) tells noise from "
                    "distortion"
                )
        texts = {"nonlinear": static, "changing": change}
        remarks += [Remark(text, omega[used], pair, kind) for kind, text in texts.items() if text]
    return tuple(remarks)


class _Spectra(NamedTuple):
    """Transforms of one record, and the part of the input that moves it."""

    grid: Float[np.ndarray, " bins"]  # rad/s
    moving: Columns  # inputs, or references
    inputs: Columns
    outputs: Columns
    added: Columns  # u |u|, u^3, u^2, t u, each of the size of u
    input: Samples  # u, without what noise adds to it in a joint estimate

    @classmethod
    def of(cls, record: Record, i: int, method: Method, scale: float) -> "_Spectra":
        count = fast_length(record.samples)
        inputs, outputs = _transform(record.inputs[:count]), _transform(record.outputs[:count])
        moving = inputs if method == "direct" else _transform(record.references[:count])
        u = record.inputs[:count, i] - np.mean(record.inputs[:count, i])
        if method == "joint":  # less what neither the references nor a transient explain
            moved = np.empty_like(inputs[:, i])
            blocks = max(moved.size // (_MOVED * moving.shape[1]), 1)
            for block in np.array_split(np.arange(moved.size), blocks):
                basis = _basis(moving[block], np.zeros(block.size, int), block)
                moved[block] = basis @ (np.conj(basis.T) @ inputs[block, i])
            u = np.fft.irfft(moved, count) * np.sqrt(count)
        v, time = u / scale, np.linspace(-1.0, 1.0, count)
        added = np.stack([u * np.abs(v), u * v**2, u * v, u * time]).T
        grid = 2 * np.pi / (count * record.dt) * np.arange(len(inputs))
        return cls(grid, moving, inputs, outputs, _transform(added), u)


def _transform(columns: Float[np.ndarray, "samples columns"]) -> Columns:
    rows = np.ascontiguousarray(columns.T)
    rows = rows - np.mean(rows, axis=1, keepdims=True)
    return np.fft.rfft(rows).T / np.sqrt(len(columns))


def _basis(
    moving: Columns, record: Int[np.ndarray, " bins"], place: Real[np.ndarray, " bins"]
) -> Complex[np.ndarray, "bins functions"]:
    """Orthonormal columns: what moves, and a transient of each record, times smooth functions."""
    span = max(float(np.ptp(place)), 1e-300)
    smooth = (2 * (place - np.mean(place)) / span)[:, None] ** np.arange(_POWERS)
    owner = record[:, None] == np.unique(record)
    parts = [(factors[:, :, None] * smooth[:, None, :]) for factors in (moving, owner)]
    columns = np.concatenate([part.reshape(place.size, -1) for part in parts], axis=1)
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    return np.linalg.qr(columns / size)[0]


class _LeftOver(NamedTuple):
    """What the local linear model leaves, at the plant's input, of all records and blocks."""

    residual: Complex[np.ndarray, " bins"]
    added: Columns  # the signals looked for: u |u|, u^3, u^2, t u, t u dlnG/dln(omega)
    leverage: Float[np.ndarray, " bins"]  # of the local linear model
    weight: Float[np.ndarray, " bins"]  # inverse variance of the residual
    share: Float[np.ndarray, " columns"]  # of these signals' power
    slope: Complex[np.ndarray, " frequencies"]  # dlnG/dln(omega)


def _left_over(
    spectra: Sequence[_Spectra],
    omega: Grid,
    response: Complex[np.ndarray, "frequencies inputs"],
    pair: tuple[int, int],
) -> _LeftOver | None:
    """`None` where no block has more bins than the local linear model has coefficients."""
    slope, parts = log_slope(omega, response[:, pair[1]]), []
    for index, part in enumerate(spectra):
        first, last = np.searchsorted(part.grid, [omega[0], omega[-1]])
        band = slice(max(int(first), 1), int(last))
        grid = part.grid[band]
        plant = interpolated(grid, omega, response)
        modelled = np.sum(plant * part.inputs[band], axis=1)
        residual = (part.outputs[band, pair[0]] - modelled) / plant[:, pair[1]]
        steep = np.interp(np.log(grid), np.log(omega), slope)[:, None]
        added = np.hstack([part.added[band], part.added[band, -1:] * steep])
        owner = np.full(residual.size, index)
        parts.append((grid, owner, part.moving[band], residual, added))
    joined = [np.concatenate(part) for part in zip(*parts, strict=True)]
    order = np.argsort(joined[0], kind="stable")
    grid, owner, moving, residual, added = (part[order] for part in joined)
    rests, both = [], np.column_stack([residual, added])
    if grid.size:  # blocks of neighbouring bins with about equally many that the input excites
        power = np.sum(np.abs(moving) ** 2 / np.mean(np.abs(moving) ** 2, axis=0), axis=1)
        excited = np.cumsum(power > _EXCITED * local_mean(power, 0))
        count = max(int(excited[-1]) // (_PER_COLUMN * _POWERS * moving.shape[1]), 1)
        ends = np.searchsorted(excited, np.linspace(0, excited[-1], count + 1)[1:-1])
        for block in np.split(np.arange(grid.size), ends):
            basis = _basis(moving[block], owner[block], grid[block])
            if block.size < basis.shape[1] + _SPARE:
                continue
            left = both[block] - basis @ (np.conj(basis.T) @ both[block])
            leverage = np.minimum(np.sum(np.abs(basis) ** 2, axis=1), 0.9)
            noise = np.mean(np.abs(left[:, 0]) ** 2 / (1 - leverage))
            noise += _FLOOR * np.mean(np.abs(added[block]) ** 2) + 1e-280
            rests.append((left, leverage, np.full(block.size, 1 / noise), added[block]))
    if not rests:
        return None
    left, leverage, weight, added = (np.concatenate(part) for part in zip(*rests, strict=True))
    powers = [np.sum(np.abs(part) ** 2, axis=0) for part in (left[:, 1:], added)]
    share = powers[0] / np.maximum(powers[1], 1e-300)
    return _LeftOver(left[:, 0], left[:, 1:], leverage, weight, share, slope)


def log_slope(
    omega: Grid, response: Complex[np.ndarray, " frequencies"]
) -> Complex[np.ndarray, " frequencies"]:
    """dlnG/dln(omega), by straight lines through the points nearby; 0 where there are none."""
    place = np.log(omega)
    logs = np.log(np.abs(response)) + 1j * np.unwrap(np.angle(response))
    offset = place - place[:, None]
    kernel = np.exp(-0.5 * (offset / _SMOOTH) ** 2)
    m0, m1, m2 = (np.sum(kernel * offset**k, axis=1) for k in range(3))
    spread, pull = m0 * m2 - m1**2, m0 * ((kernel * offset) @ logs) - m1 * (kernel @ logs)
    alone = spread <= _ALONE * (m0 * _SMOOTH) ** 2
    return np.where(alone, 0.0, pull / np.where(alone, 1.0, spread))


class _Factors(NamedTuple):
    value: Float[np.ndarray, " columns"]
    covariance: Float[np.ndarray, "columns columns"]

    @classmethod
    def of(cls, left: _LeftOver, columns: Columns) -> "_Factors":
        """Real factors of the columns in the residual.

        The covariance is that of residuals of any variance at each bin (MacKinnon and White, 1985,
        HC3).
        """
        weighted = np.conj(columns) * left.weight[:, None]
        inverse = np.linalg.inv(np.real(weighted.T @ columns))
        value = inverse @ np.real(weighted.T @ left.residual)
        leverage = np.real(np.sum((weighted @ inverse) * columns, axis=1)) / 2
        rest = (left.residual - columns @ value) / (1 - np.minimum(left.leverage + leverage, 0.9))
        score = np.real(weighted * rest[:, None]) @ inverse
        return cls(value, score.T @ score)

    def size(self) -> float:
        """In standard errors: the root of a chi-squared variable."""
        return float(np.sqrt(self.value @ np.linalg.solve(self.covariance, self.value)))


class _Gains(NamedTuple):
    """The gains of a static nonlinearity at two commands, relative to that of the response."""

    low: float = 1.0
    high: float = 1.0
    clear: float = 0.0  # the nonlinearity in standard errors; 0 where it is not clear

    @classmethod
    def at(
        cls, left: _LeftOver, columns: list[int], v: Samples, x: Samples, percentiles: list[int]
    ) -> "_Gains":
        """At two percentiles of x; factors must be real: no dynamics before a nonlinearity."""
        if np.min(left.share[columns]) < _DISTINCT_STATIC:
            return cls()
        ends = np.percentile(x, percentiles)
        added = left.added[:, columns]
        factors = _Factors.of(left, added)
        clear = factors.size()
        if clear < _CLEAR or clear < 2 * _Factors.of(left, 1j * added).size():
            return cls()
        powers = [_POWER[column] for column in columns]
        mean = [np.sum(x**power * v**2) / np.sum(v**2) for power in powers]
        gains = 1 + (ends[:, None] ** powers - mean) @ factors.value
        low, high = np.maximum(gains, 0.0).tolist()
        return cls(low, high, clear)

    def difference(self) -> float:
        """Relative to the larger one."""
        return abs(self.high - self.low) / max(self.high, self.low)


def _static(left: _LeftOver, v: Samples) -> str:
    """What functions of the command v, of unit size, say of the gain."""
    size, percentiles = np.abs(v), [_SMALL, _LARGE]
    # By v |v|, v^3, or both where these explain more.
    first, second = (_Gains.at(left, [column], v, size, percentiles) for column in (0, 1))
    odd = first if first.clear > second.clear else second
    if odd.clear:
        both = _Gains.at(left, [0, 1], v, size, percentiles)
        odd = both if both.clear**2 > odd.clear**2 + _MORE**2 else odd
    even, texts = _Gains.at(left, [2], v, v, [_NEGATIVE, _LARGE]), []
    if odd.difference() > _SMALLEST:
        where, cause = _FALLS if odd.high < odd.low else _RISES
        texts.append(f"falls by about {100 * odd.difference():.2g} % from {where}, as {cause}")
    if even.difference() > _SMALLEST:
        side = "smaller" if even.high < even.low else "larger"
        texts.append(
            f"is about {100 * even.difference():.2g} % {side} for positive commands than for "
            "negative ones"
        )
    if not texts:
        return ""
    return (
        f"the plant is not linear: its gain {' and '.join(texts)}. The error bars do not include "
        "this. Log what the actuator does (its position or rpm) as the input, or identify at the "
        "amplitudes of use"
    )


_FALLS = (
    "small commands to the largest",
    "a saturation causes, or noise in the measured input",
)
_RISES = "the largest commands to small ones", "a deadband or friction causes"


def period_of(signals: Sequence[Float[np.ndarray, "_samples sources"]]) -> int:
    """Samples of the shortest period with which all signals repeat exactly; 0 without one.

    Every signal holds two whole periods at least.
    """
    most = min(len(signal) for signal in signals) // 2
    lags, first = np.arange(4, most + 1), signals[0]
    near = _EXACT * max(float(np.max(np.abs(signal))) for signal in signals)
    for place in np.linspace(0, len(first) - most - 1, _PLACES).astype(int):
        lags = lags[np.all(np.abs(first[place + lags] - first[place]) <= near, axis=1)]
    for lag in lags.tolist():
        if all(np.all(np.abs(x[lag:] - x[:-lag]) <= near) for x in signals):
            return lag
    return 0


def _change(left: _LeftOver, omega: Grid, method: Method) -> str:
    """What the input times time says of the response, in magnitude and phase."""
    if left.share[3] < _DISTINCT_CHANGE:
        return ""
    columns = np.hstack([left.added[:, 3:], 1j * left.added[:, 3:]])
    # Combinations of the columns that differ, of equal size.
    weighted = columns * np.sqrt(left.weight)[:, None]
    real = np.concatenate([np.real(weighted), np.imag(weighted)])
    _, strength, turned = np.linalg.svd(real, full_matrices=False)
    distinct = strength > _DEPENDENT * strength[0]
    distinct = turned[distinct].T / strength[distinct]
    factors = _Factors.of(left, columns @ distinct)
    if not factors.size() > _CLEAR:
        return ""
    # Of t, from -1 to 1, the mean in the second half is 1 more than that in the first.
    gains = np.stack([np.ones_like(left.slope), left.slope], axis=1)
    rows = np.hstack([gains, 1j * gains]) @ distinct
    change = np.abs(rows @ factors.value)
    doubt = np.real(np.sum((rows @ factors.covariance) * np.conj(rows), axis=1))
    at = int(np.argmax(change / np.sqrt(doubt)))
    if not change[at] > _SMALLEST:
        return ""
    loop = "; in a closed loop, name a reference («references=»)" if method == "direct" else ""
    return (
        f"the response changes during the record: by about {100 * change[at]:.2g} % "
        f"near {in_hertz(omega[[at]])} from its first half to its second, which the error bars "
        f"do not include. Identify the parts by themselves («start=», «stop=»){loop}"
    )
