"""Windowed transforms of all records and window lengths, laid end to end without a seam."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxquad._core import require_x64
from jaxquad.records import Record

from ._blocks import lattice_windows
from ._estimators import Welch
from ._transform import transform_windows
from ._window import segment_starts


Layout = tuple[tuple[int, tuple[int, ...]], ...]  # length and starts of each set of windows


class Segments(NamedTuple):
    """Transforms of one set of windows for each length, in absolute phase.

    Channels stand as in `Record.names`: inputs, outputs, references. `groups` are the lengths and
    the starts in samples, of the records one after the other, with gaps wider than any window.
    """

    transforms: tuple[Complex[Array, "windows frequencies channels"], ...]
    groups: Layout


def transform_records(
    records: Sequence[Record], omega: Float[np.ndarray, " frequencies"], members: Sequence[Welch]
) -> Segments:
    """Transform all channels of all records; no window spans the seam of two records."""
    require_x64("a frequency response")
    layouts = _layouts(records, omega, members)
    parts, starts, origin = [], [[] for _ in members], 0
    for record, layout in zip(records, layouts, strict=True):
        parts.append(_transform_record(record, omega, members[0], layout, origin))
        for mine, (_, local) in zip(starts, layout, strict=True):
            mine += [origin + start for start in local]
        origin += record.samples + max(length for length, _ in layout)
    kinds = zip(*parts, strict=True)
    joined = tuple(mine[0] if len(mine) == 1 else jnp.concatenate(mine) for mine in kinds)
    lengths = [length for length, _ in layouts[0]]
    return Segments(joined, tuple(zip(lengths, map(tuple, starts), strict=True)))


def _layouts(
    records: Sequence[Record], omega: Float[np.ndarray, " frequencies"], members: Sequence[Welch]
) -> list[Layout]:
    """Lengths and starts for each record. One window keeps its length to the sample.

    Several, whose lengths are a choice of ours, take lengths that share blocks of samples.
    """
    lengths = tuple(member.length(records) for member in members)
    samples = [record.samples - members[0].integrators for record in records]
    overlap = members[0].overlap
    if len(members) == 1:
        return [((lengths[0], segment_starts(n, lengths[0], overlap)),) for n in samples]
    angle = omega * records[0].dt
    shared = tuple(n for n, _ in lattice_windows(min(samples), lengths, overlap, angle))
    return [lattice_windows(n, shared, overlap, angle) for n in samples]


def _transform_record(
    record: Record,
    omega: Float[np.ndarray, " frequencies"],
    welch: Welch,
    layout: Layout,
    origin: int,
) -> list[Complex[Array, "_ frequencies channels"]]:
    n, late = welch.integrators, welch.late(record)
    outputs = np.diff(record.outputs, n, axis=0)
    outputs = np.concatenate([outputs[late:], np.repeat(outputs[-1:], late, axis=0)])
    # A difference looks back by n/2 samples, which the window would weigh like any other delay.
    centre = slice(n - n // 2, record.samples - n // 2)
    columns = np.hstack([record.inputs[centre], outputs, record.references[centre]])
    angle = omega * record.dt
    found = transform_windows(
        columns, angle, layout, shape=welch.shape, detrend=welch.detrend, origin=float(origin)
    )
    if not (n or late):
        return found
    factor = np.ones((omega.size, columns.shape[1]), complex)
    first = len(record.input_names)
    recolour = np.exp(-1j * (late + n // 2) * angle) / (1 - np.exp(-1j * angle)) ** n
    factor[:, first : first + outputs.shape[1]] = recolour[:, None]
    return [part * factor[None] for part in found]
