"""Windowed transforms of all records and window lengths, laid end to end without a seam."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxquad.records import Record

from ._precision import require_x64
from ._transform import segment_transforms
from ._welch import Welch
from ._window import segment_starts, window


class Segments(NamedTuple):
    """Transforms of one set of windows for each length, in absolute phase.

    Channels stand as in `Record.names`: inputs, outputs, references. `groups` are the lengths and
    the starts in samples, of the records one after the other, with gaps wider than any window.
    """

    transforms: tuple[Complex[Array, "windows frequencies channels"], ...]
    groups: tuple[tuple[int, tuple[int, ...]], ...]


def transform_records(
    records: Sequence[Record], omega: Float[np.ndarray, " frequencies"], members: Sequence[Welch]
) -> Segments:
    """Transform all channels of all records; no window spans the seam of two records."""
    require_x64("a frequency response")
    lengths = [member.length(records) for member in members]
    parts, starts, origin = [[] for _ in members], [[] for _ in members], 0
    for record in records:
        for k, (member, length) in enumerate(zip(members, lengths, strict=True)):
            local = segment_starts(record.samples - member.integrators, length, member.overlap)
            parts[k].append(_transform_record(record, omega, member, local, length, origin))
            starts[k] += [origin + start for start in local]
        origin += record.samples + max(lengths)
    joined = tuple(mine[0] if len(mine) == 1 else jnp.concatenate(mine) for mine in parts)
    groups = zip(lengths, map(tuple, starts), strict=True)
    return Segments(joined, tuple(groups))


def _transform_record(
    record: Record,
    omega: Float[np.ndarray, " frequencies"],
    welch: Welch,
    starts: tuple[int, ...],
    length: int,
    origin: int,
) -> Complex[Array, "segments frequencies channels"]:
    n, late = welch.integrators, welch.late(record)
    outputs = np.diff(record.outputs, n, axis=0)
    outputs = np.concatenate([outputs[late:], np.repeat(outputs[-1:], late, axis=0)])
    # A difference looks back by n/2 samples, which the window would weigh like any other delay.
    centre = slice(n - n // 2, record.samples - n // 2)
    columns = np.hstack([record.inputs[centre], outputs, record.references[centre]])
    angle = omega * record.dt
    factor = np.ones((omega.size, columns.shape[1]), complex)
    first = len(record.input_names)
    recolour = np.exp(-1j * (late + n // 2) * angle) / (1 - np.exp(-1j * angle)) ** n
    factor[:, first : first + outputs.shape[1]] = recolour[:, None]
    return segment_transforms(
        columns, starts, window(welch.shape, length), angle, welch.detrend,
        origin=np.asarray(float(origin)), factor=factor,
    )  # fmt: skip
