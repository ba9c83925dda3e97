"""A discrete model from a record by linear least squares: a start for output error."""

import numpy as np

from jaxquad.models import DiscreteTransferFunction
from jaxquad.records import Record

from .output_error._simulated import check_channels


_PASSES = 6


def guess_discrete(
    record: Record, zeros: int, poles: int, *, delay: int = 0
) -> DiscreteTransferFunction:
    """Starting values for a discrete model of one input and one output: ARX, and filtered ARX.

    Least squares of A(q) y = B(q) u with an offset, then again with both filtered by 1 / A of the
    pass before, as far as these lower what the model by itself leaves of the outputs. Noise biases
    them, so they have no errors: `jq.refine` does.

    **Arguments:**

    - `record`: of one input and one output.
    - `zeros`, `poles`: as many coefficients follow the first one of numerator and denominator; a
        plant behind a hold has one zero less than poles.
    - `delay`: in whole samples, beyond the poles - zeros that the powers of z are late.

    **Raises:** ValueError for more zeros than poles, no pole, other channels, and too few samples.

    Source: Ljung, System Identification, sec. 4.2 (ARX) and 10.4; Steiglitz & McBride, A technique
    for the identification of linear systems, IEEE Trans. Automatic Control 10 (1965).
    """
    from scipy.signal import lfilter

    if not 0 <= zeros <= poles or not poles or delay < 0:
        raise ValueError(
            f"zeros is {zeros}, poles {poles} and delay {delay}: give at least one pole, as many "
            "zeros at most, and a delay of 0 samples or more"
        )
    check_channels(DiscreteTransferFunction([1.0], [1.0], record.dt), record)
    late, count = delay + poles - zeros, zeros + poles + 1
    first = max(late + zeros, poles)  # samples that what was before the record reaches directly
    if record.samples < 2 * (count + first):
        raise ValueError(
            f"the record has {record.samples} samples for {count} coefficients: record longer"
        )
    signals = (np.asarray(part, float)[:, 0] for part in (record.inputs, record.outputs))
    u, y = (x - x[0] for x in signals)

    late_by = lambda x, n: np.concatenate([np.zeros(n), x[: len(x) - n]])

    def free_motions(below: np.ndarray) -> list[np.ndarray]:
        """What an offset and all that was before the record add to signals behind 1 / `below`."""
        pushes = [np.ones_like(u), *np.eye(first, u.size)]
        return [np.asarray(lfilter([1.0], below, push)) for push in pushes]

    def least_squares(columns: list[np.ndarray], aim: np.ndarray) -> tuple[np.ndarray, float]:
        """The numbers, and the mean square of what is left."""
        matrix = np.column_stack(columns)
        size = np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
        numbers = np.linalg.lstsq(matrix / size, aim, rcond=1e-12)[0] / size
        return numbers, float(np.mean((aim - matrix @ numbers) ** 2))

    best, least, below = (np.ones(0), np.ones(0)), np.inf, np.ones(1)
    with np.errstate(all="ignore"):
        for _ in range(_PASSES):
            drive, aim = (np.asarray(lfilter([1.0], below, x)) for x in (u, y))
            columns = [late_by(drive, late + n) for n in range(zeros + 1)]
            columns += [-late_by(aim, n + 1) for n in range(poles)]
            numbers, _ = least_squares([*columns, *free_motions(below)], aim)
            above, below = numbers[: zeros + 1], np.append(1.0, numbers[zeros + 1 : count])
            best = best if best[0].size else (above, below)
            if not np.max(np.abs(np.roots(below))) < 1:
                break  # a filter that grows tells nothing
            error = y - late_by(lfilter(above, below, u), late)
            rest = least_squares([np.ones_like(u), *free_motions(below)], error)[1]
            if rest < least:
                best, least = (above, below), rest
    return DiscreteTransferFunction(*best, dt=record.dt, delay=delay)
