import functools as ft
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxquad._core import require_x64

from ._blocks import band_edges, choose_lattice, Lattice, nested_basis, rank, window_tables
from ._window import window


_SHORT = 128  # samples below which a window is summed directly
_FULL = 0.7  # functions to a sample of a block, beyond which compression does not pay


class WindowTables(eqx.Module):
    """Tables that convert samples to the Fourier sums of all windows of one length."""

    tables: tuple[Float[Array, "2 _ _"], ...]  # one to a band of the compressed blocks
    taper: Float[Array, " window"]  # for the frequencies above the bands
    turn: Complex[Array, "frequencies segments"]  # phase from the record's first sample
    length: int = eqx.field(static=True)
    starts: tuple[int, ...] = eqx.field(static=True)


class Plan(eqx.Module):
    """Tables and layout of a transform; frequencies in ascending order of magnitude."""

    windows: tuple[WindowTables, ...]
    basis: Float[Array, "block rank"]
    angle: Float[Array, " frequencies"]  # ascending in magnitude
    ranks: tuple[int, ...] = eqx.field(static=True)  # of the bands
    lattice: Lattice = eqx.field(static=True)
    order: tuple[int, ...] | None = eqx.field(static=True)  # back to the caller's, if it differs
    detrend: str = eqx.field(static=True)


@ft.lru_cache(maxsize=12)
def plan_transform(
    samples: int,
    angle: tuple[float, ...],  # rad per sample
    windows: tuple[tuple[int, tuple[int, ...]], ...],
    shape: str,
    detrend: str,
    first: int = 0,
) -> Plan:
    """The tables of a transform, cached: they depend on the layout of a record, not on samples.

    Those of the windows from number `first` on, on the blocks of all of them.
    """
    _check(samples, angle, windows, detrend)
    forward = np.argsort(np.abs(angle), kind="stable")
    omega = np.asarray(angle, float)[forward]
    long = [each for each in windows if each[0] >= _SHORT]
    lattice = choose_lattice(samples, long, np.abs(omega)) if long else Lattice(1, 0, samples)
    bands, basis, ranks = _bands(lattice.block, omega, min([n for n, _ in long], default=1))
    # Arrays made while JAX traces would not outlive the trace, and this plan is kept.
    with jax.ensure_compile_time_eval():
        made = tuple(
            _window(n, starts, shape, detrend, omega, bands if n >= _SHORT else [], basis, ranks)
            for n, starts in windows[first:]
        )
        straight = np.array_equal(forward, np.arange(omega.size))
        order = None if straight else tuple(int(i) for i in np.argsort(forward))
        return Plan(
            made, jax.device_put(basis), jax.device_put(omega), ranks, lattice, order, detrend
        )  # fmt: skip


def _check(
    samples: int,
    angle: tuple[float, ...],
    windows: tuple[tuple[int, tuple[int, ...]], ...],
    detrend: str,
) -> None:
    if detrend not in ("none", "constant", "linear"):
        raise ValueError(f"detrend is {detrend!r}: use none, constant or linear")
    if not angle or not np.all(np.abs(angle) <= np.pi):
        worst = max(angle, key=abs, default=None)
        raise ValueError(
            f"angle {worst} rad per sample is not within -pi to pi, the Nyquist frequency: give at "
            "least one frequency, and none above half the sample rate"
        )
    if not windows:
        raise ValueError("there are no windows: give at least one pair (length, starts)")
    for length, starts in windows:
        if length < 2 or not starts or min(starts) < 0 or max(starts) + length > samples:
            raise ValueError(
                f"windows of {length} samples that start at {min(starts, default=None)} to "
                f"{max(starts, default=None)} do not fit a record of {samples} samples: starts "
                f"must lie between 0 and {samples - length}, and a window must hold 2 samples"
            )


def _bands(
    block: int, omega: Float[np.ndarray, " frequencies"], shortest: int
) -> tuple[list[Float[np.ndarray, " _"]], Float[np.ndarray, "block rank"], tuple[int, ...]]:
    """Bands of the frequencies that compression serves, their basis and the ranks."""
    # A raised cosine shifts frequencies by one cycle to its window.
    reach = np.abs(omega) + 2 * np.pi / shortest
    ranks = rank(block, reach)
    served = int(np.count_nonzero(ranks <= _FULL * block))
    if not served:
        return [], np.ones((block, 1)), ()
    ends = band_edges(ranks[:served])
    basis, sizes = nested_basis(block, [float(reach[end - 1]) for end in ends])
    return np.split(omega[:served], ends[:-1]), basis, sizes


def _window(
    length: int,
    starts: tuple[int, ...],
    shape: str,
    detrend: str,
    omega: Float[np.ndarray, " frequencies"],
    bands: list[Float[np.ndarray, " _"]],
    basis: Float[np.ndarray, "block rank"],
    ranks: Sequence[int],
) -> WindowTables:
    tables = window_tables(length, shape, detrend, bands, basis, ranks) if bands else []
    turn = np.exp(-1j * omega[:, None] * np.asarray(starts, float))
    taper = jax.device_put(window(shape, length))
    return WindowTables(
        tuple(jax.device_put(table) for table in tables),
        taper,
        jax.device_put(turn),
        length,
        starts,
    )


def transform_windows(
    signals: Float[np.ndarray, "samples channels"],
    angle: Float[np.ndarray, " frequencies"],
    windows: tuple[tuple[int, tuple[int, ...]], ...],
    *,
    shape: str = "hann",
    detrend: str = "constant",
    origin: float = 0.0,
) -> list[Complex[Array, "frequencies segments channels"]]:
    """Fourier sums of tapered windows of several lengths, at any frequencies at once.

    `sum_n taper[n] x[start + n] exp(-j angle (origin + start + n))`, one array for each pair
    (length, starts) of `windows`, with `angle` in rad per sample: the phase is absolute, of a
    record whose first sample is number `origin`. `detrend` removes the "constant" or the "linear"
    least-squares trend of every window before the taper, or "none". Tables are made at the first
    call for a layout and cached. Raises `ValueError` for windows outside the record or frequencies
    above the Nyquist frequency, `PrecisionError` in 32 bits.

    Blocks of samples are compressed once, for all windows, to the few functions that these
    frequencies can distinguish; each length is then a small matrix product. Accurate to about 2e-13
    of the largest sum. Fast where lengths are multiples of a block: see `lattice_windows`.
    """
    tapers = (Taper(shape, signals.shape[1]),)
    return transform_tapers((signals,), angle, windows, tapers, detrend=detrend, origin=origin)[0]


class Taper(NamedTuple):
    """A window's shape and what it acts on: so many of the channels, windows from `first` on."""

    shape: str
    channels: int
    first: int = 0


def transform_tapers(
    signals: tuple[Float[np.ndarray, "samples _"], ...],
    angle: Float[np.ndarray, " frequencies"],
    windows: tuple[tuple[int, tuple[int, ...]], ...],
    tapers: tuple[Taper, ...],
    *,
    detrend: str,
    origin: float,
) -> list[list[Complex[Array, "frequencies segments _"]]]:
    """`transform_windows` of signals side by side, for several tapers."""
    require_x64("a transform")
    angles, most = tuple(np.asarray(angle, float).tolist()), len(signals[0])
    plans = tuple(
        plan_transform(most, angles, windows, each.shape, detrend, each.first) for each in tapers
    )
    channels = tuple(each.channels for each in tapers)
    columns = tuple(np.asarray(each, float) for each in signals)
    return _transform(plans, channels, columns, np.asarray(origin, float))


@ft.partial(jax.jit, static_argnums=1)
def _transform(
    plans: tuple[Plan, ...],
    channels: tuple[int, ...],
    signals: tuple[Float[Array, "samples _"], ...],
    origin: Float[Array, ""],
) -> list[list[Complex[Array, "frequencies segments _"]]]:
    """All plans are of one layout: the compressed blocks serve each of them."""
    plan = plans[0]
    if plan.detrend != "none":  # No trend is left of a constant, but its rounding errors would be.
        signals = tuple(each - jnp.mean(each, axis=0)[None, :] for each in signals)
    lattice, rows = plan.lattice, jnp.concatenate([each.T for each in signals])
    used = rows[:, lattice.offset : lattice.offset + lattice.count * lattice.block]
    blocks = used.reshape(rows.shape[0], lattice.count, lattice.block) @ plan.basis
    return [
        _apply_plan(each, rows[:count], blocks[:count], origin)
        for each, count in zip(plans, channels, strict=True)
    ]


def _apply_plan(
    plan: Plan,
    rows: Float[Array, "channels samples"],
    blocks: Float[Array, "channels blocks rank"],
    origin: Float[Array, ""],
) -> list[Complex[Array, "frequencies segments channels"]]:
    sums = [_window_sums(plan, each, rows, blocks) for each in plan.windows]
    phase = turn(origin * plan.angle)
    turned = [
        x * (each.turn * phase[:, None])[:, :, None]
        for x, each in zip(sums, plan.windows, strict=True)
    ]
    if plan.order is None:
        return turned
    return [each[np.array(plan.order)] for each in turned]


def _window_sums(
    plan: Plan,
    window: WindowTables,
    rows: Float[Array, "channels samples"],
    blocks: Float[Array, "channels blocks rank"],
) -> Complex[Array, "frequencies segments channels"]:
    parts = []
    if window.tables:
        parts.append(_compressed_sums(plan, window, rows, blocks))
    above = plan.angle[sum(table.shape[1] for table in window.tables) :]
    if above.size:
        cut = jnp.moveaxis(_slices(rows, window.starts, window.length), 2, 1)
        tapered = _remove_trend(cut, plan.detrend) * window.taper[None, :, None]
        parts.append(_fourier_sums(tapered, above))
    return jnp.concatenate(parts)


def _compressed_sums(
    plan: Plan,
    window: WindowTables,
    rows: Float[Array, "channels samples"],
    blocks: Float[Array, "channels blocks rank"],
) -> Complex[Array, "frequencies segments channels"]:
    lattice = plan.lattice
    count = -(-window.length // lattice.block)  # the last block may be cut short
    on = [lattice.holds(window.length, start) for start in window.starts]
    first = [(start - lattice.offset) // lattice.block for start in window.starts]
    aligned = tuple(itertools.compress(first, on))
    astray = tuple(start for start, yes in zip(window.starts, on, strict=True) if not yes)
    own = _compress(plan, _slices(rows, astray, window.length)) if astray else None
    sums = []
    for table, size in zip(window.tables, plan.ranks, strict=True):
        cut = [_slices(blocks[:, :, :size], aligned, count)] if aligned else []
        cut += [own[..., :size]] if own is not None else []
        flat = jnp.concatenate(cut).reshape(-1, count * size)
        # One plain product of two matrices: XLA's general contraction takes a third longer.
        both = table.reshape(-1, count * size) @ flat.T
        sums.append(both.reshape(2, table.shape[1], len(on), -1))
    real, imag = jnp.concatenate(sums, axis=1)
    places = np.argsort(np.argsort(~np.array(on), kind="stable"))
    joined = jax.lax.complex(real, imag)
    return joined if all(on) or not any(on) else joined[:, places]


def _compress(
    plan: Plan, segments: Float[Array, "segments channels window"]
) -> Float[Array, "segments channels blocks rank"]:
    """Blocks of windows that do not lie on whole blocks of the record."""
    block = plan.lattice.block
    padding = -segments.shape[2] % block
    whole = jnp.pad(segments, ((0, 0), (0, 0), (0, padding)))
    return whole.reshape(*segments.shape[:2], -1, block) @ plan.basis


def _slices(
    values: Float[Array, "channels places *rest"], starts: tuple[int, ...], length: int
) -> Float[Array, "segments channels length *rest"]:
    # Contiguous slices: a gather of indices is several times slower, a stack slow to compile.
    cut = lambda start: jax.lax.dynamic_slice_in_dim(values, start, length, axis=1)
    return jax.vmap(cut)(np.array(starts))


def turn(angle: Float[Array, "*shape"]) -> Complex[Array, "*shape"]:
    """`exp(-j angle)`, in the precision of `angle`."""
    return jax.lax.complex(jnp.cos(angle), -jnp.sin(angle))


def _remove_trend(
    segments: Float[Array, "segments window channels"], detrend: str
) -> Float[Array, "segments window channels"]:
    if detrend == "none":
        return segments
    centred = segments - jnp.mean(segments, axis=1, keepdims=True)
    if detrend == "constant":
        return centred
    ramp = jnp.linspace(-1.0, 1.0, segments.shape[1], dtype=segments.dtype)
    slope = jnp.einsum("n,snc->sc", ramp, centred) / jnp.sum(ramp**2)
    return centred - ramp[None, :, None] * slope[:, None, :]


def _fourier_sums(
    segments: Float[Array, "segments window channels"], angle: Float[Array, " frequencies"]
) -> Complex[Array, "frequencies segments channels"]:
    """Two levels, within short blocks and over the blocks, so that few exponentials are needed."""
    count, window, channels = segments.shape
    block = max(int(np.sqrt(window)), 1)
    blocks = -(-window // block)
    padded = jnp.pad(segments, ((0, 0), (0, blocks * block - window), (0, 0)))
    parts = padded.reshape(count, blocks, block, channels)
    inner = angle[:, None] * jnp.arange(block, dtype=angle.dtype)[None, :]
    outer = angle[:, None] * jnp.arange(0, blocks * block, block, dtype=angle.dtype)[None, :]
    # Real factors: a product of a real with a complex array would double the arithmetic.
    real = jnp.einsum("sbnc,fn->sbfc", parts, jnp.cos(inner))
    imag = jnp.einsum("sbnc,fn->sbfc", parts, jnp.sin(inner))
    return jnp.einsum("sbfc,fb->fsc", jax.lax.complex(real, -imag), turn(outer))
