import functools as ft
from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Complex, Float

from ._blocks import band_edges, nested_basis, rank, window_tables
from ._lattice import choose_lattice, Lattice
from ._window import window


_SHORT = 128  # samples below which a window is summed directly
_FULL = 0.7  # functions to a sample of a block, beyond which compression does not pay


class WindowTables(eqx.Module):
    """What turns samples into the Fourier sums of all windows of one length."""

    tables: tuple[Float[Array, "2 _ _"], ...]  # one to a band of the compressed blocks
    taper: Float[Array, " window"]  # for the frequencies above the bands
    turn: Complex[Array, "segments frequencies"]  # phase from the record's first sample
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


@ft.lru_cache(maxsize=4)
def plan_transform(
    samples: int,
    angle: tuple[float, ...],  # rad per sample
    windows: tuple[tuple[int, tuple[int, ...]], ...],
    shape: str,
    detrend: str,
) -> Plan:
    """Make the tables, or find them: they depend on the layout of a record, not on its samples."""
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
            for n, starts in windows
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
        raise ValueError(f"detrend {detrend!r}: choose none, constant or linear")
    if not angle or not np.all(np.abs(angle) <= np.pi):
        worst = max(angle, key=abs, default=None)
        raise ValueError(
            f"angle {worst} rad per sample is not within +-pi, the Nyquist frequency: give at "
            "least one frequency, and none above half the sample rate"
        )
    if not windows:
        raise ValueError("no windows: give at least one (length, starts)")
    for length, starts in windows:
        if length < 2 or not starts or min(starts) < 0 or max(starts) + length > samples:
            raise ValueError(
                f"windows of {length} samples from {min(starts, default=None)} to "
                f"{max(starts, default=None)} do not fit a record of {samples} samples: starts "
                f"must lie between 0 and {samples - length}, and a window hold 2 samples"
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
    turn = np.exp(-1j * np.asarray(starts, float)[:, None] * omega)
    taper = jax.device_put(window(shape, length))
    return WindowTables(
        tuple(jax.device_put(table) for table in tables),
        taper,
        jax.device_put(turn),
        length,
        starts,
    )
