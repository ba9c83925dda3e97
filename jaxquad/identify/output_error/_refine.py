"""Fits of models to records in the time domain."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxquad._core import Message, one_blas_thread, require_x64
from jaxquad.models import with_arrays
from jaxquad.records import Record

from ..frequency_domain._fit import check_priors
from ..frequency_domain._parameters import Free, select_parameters, Tie
from ..frequency_domain._problem import make_problem, Prior, require_model, require_priors
from ..frequency_domain._refits import free_again
from ..frequency_domain._result import Fit
from ._descent import descend_by_turns, descend_with_noise
from ._noise import ARMA, AutoRegressive, Noise
from ._problem import evaluate_misfits, feedback_response, KnownController, OutputError, RecordTerm
from ._result import assess_output_error
from ._simulated import (
    band_filter,
    band_gain,
    check_channels,
    check_growth,
    count_states,
    DifferentialModel,
    inputs_between_samples,
    Linear,
    linear_model,
    unknown_motions,
)


_SHORT = 200_000  # samples, up to which a second thread of BLAS waits about as long as it works


def refine(
    model: PyTree | Fit,
    record: Record | Sequence[Record],
    *,
    noise: Noise | None = None,
    free: Free = None,
    tied: Mapping[str, Tie] | None = None,
    loop: KnownController | None = None,
    hold: str | None = None,
    band: tuple[float, float] | None = None,
    priors: Sequence[Prior] = (),
    max_steps: int = 64,
) -> Fit:
    """Estimate of a model's `free` parameters in the time domain: output or prediction error.

    Outputs are weighted by the variance of their residuals, which is estimated in turn with the
    parameters; `Fit.cost` is in units of it. Standard errors hold for coloured residuals. Each
    record has its own initial state, trim and noise level. With a `noise` model, the errors of
    predicting each sample from those before it take the place of the residuals: an efficient
    estimate in coloured noise, and a consistent one where feedback returns noise to the input, as
    far as the noise model is right. With the controller of the `loop` the residuals are those of
    the closed loop, S (y - G u): what its references do not explain. That is consistent whatever
    the noise, and a noise model makes it efficient.

    **Arguments:**

    - `model`: its values are the start. A linear model (`jq.TransferFunction`, `jq.StateSpace`, or
        one with `transfer_function()` or `state_space()`) is discretised exactly; initial state,
        biases on the state derivatives and a shift of each output are eliminated by least squares.
        Any other `eqx.Module` with `init()`, `derivative(state, inputs, disturbance)` and
        `measure(state)` is integrated by diffrax with a disturbance of zero; its initial state is
        estimated as a change of `init()`. A `jq.identify.Fit` starts from its values, with its
        free and tied parameters unless others are given.
    - `record`: a `jq.Record` or a list of them.
    - `noise`: None for white noise (output error), or a model of each output's own noise:
        `jq.identify.AutoRegressive(order)`, `jq.identify.ARMA(poles, zeros)`, or "auto" for the one
        of lowest Akaike criterion, with a `loop` always autoregressive. `Fit.noise_models` has what
        was found.
    - `free`, `tied`, `priors`: as in `jq.fit`.
    - `loop`: the controller that closed the loop in which the record was flown, as `jq.PID` or
        `jq.LADRC`: anything with a method `linear()`, taken as exact and without limits. The
        reference need not be in the record. One input and one output, held at the record's rate.
    - `hold`, `band`: as in `jq.verify`, the hold by default as each record says; model and data are
        filtered alike.
    - `max_steps`: of the solver.

    **Returns:**

    A `jq.identify.Fit`.

    **Raises:**

    - `ValueError`: what `jq.fit` and `jq.verify` refuse, a model that cannot be simulated from
        its starting values, a band beside a noise model or a loop, and a controller that does not
        go with the record.
    - `PrecisionError`, a `ValueError`: JAX runs in 32 bits.

    Source: Klein & Morelli, Aircraft System Identification, ch. 6 (modified Newton-Raphson with
    relaxation, errors corrected for coloured residuals); Ljung, System Identification, ch. 7.
    """
    require_x64("an output-error fit")
    if isinstance(model, Record):
        require_model("refine", model)
    records = [record] if isinstance(record, Record) else list(record)
    if not records or not all(isinstance(one, Record) for one in records):
        kinds = ", ".join(sorted({type(one).__name__ for one in records})) or "nothing"
        raise ValueError(f"refine needs a jq.Record or a list of them, not {kinds}: see jq.read")
    if max_steps < 1:
        raise ValueError(f"max_steps is {max_steps}: give at least 1")
    for one in records:
        still = [n for n, y in zip(one.output_names, one.outputs.T, strict=True) if not np.ptp(y)]
        if still:
            raise ValueError(
                Message(f"output {still[0]} is constant: leave it out« with jq.records.select»")
            )
    if not (noise in (None, "auto") or isinstance(noise, AutoRegressive | ARMA)):
        raise ValueError(
            f"noise is {noise!r}: give None (white), jq.identify.AutoRegressive(order), "
            'jq.identify.ARMA(poles, zeros) or "auto"'
        )
    if noise is not None and band is not None:
        raise ValueError(
            f"band {band} rad/s and a noise model exclude each other: outside the band there is no "
            "noise left to model. Give noise alone: it weights each frequency by its noise"
        )
    if loop is not None and band is not None:
        raise ValueError(
            f"band {band} rad/s and a loop exclude each other: leave the band out, a noise model "
            'weights each frequency by its noise (noise="auto")'
        )
    longest = max(one.samples for one in records)
    near = isinstance(model, Fit)
    if isinstance(model, Fit):  # its choice of parameters holds where no other is given
        if tied is None:
            tied = {place.name: tie for place, tie in model.parameters.ties}
        free = free_again(model.parameters) if free is None else free
        model = model.model
    else:
        require_model("refine", model)
    model = with_arrays(model)
    parameters = select_parameters(model, free, tied)
    require_priors(model, priors)
    base = make_problem(model, parameters, (), priors=priors)
    if noise == "auto" and loop is not None:
        noise = AutoRegressive()  # a loop shapes its noise by more poles than a few zeros follow
    with one_blas_thread() if longest <= _SHORT else contextlib.nullcontext():
        terms = tuple(_term(model, one, hold, band, loop) for one in records)
        changed = {p.leaf for p in parameters.places} | {p.leaf for p, _ in parameters.ties}
        leaves = jax.tree.leaves(eqx.filter(model, eqx.is_inexact_array))
        still = [k for k, leaf in enumerate(leaves) if not np.any(np.asarray(leaf))]
        zeros = tuple(k for k in still if k not in changed)
        problem = _with_units(OutputError(base, terms, zeros))
        if noise is None:
            descent = descend_by_turns(problem, max_steps)
        else:
            descent = descend_with_noise(problem, noise, max_steps, near=near)
        check_priors(base, descent.solution)
        return assess_output_error(descent, records)


def _term(
    model: PyTree,
    record: Record,
    hold: str | None,
    band: tuple[float, float] | None,
    loop: KnownController | None,
) -> RecordTerm:
    u, between = inputs_between_samples(record, hold)
    gain = band_gain(band, record)
    feedback = None if loop is None else np.asarray(feedback_response(loop, record, between))
    if isinstance(model, DifferentialModel) and not isinstance(model, Linear):
        if loop is not None:
            raise ValueError(
                f"{type(model).__name__} is given by its differential equation, but a loop needs a "
                "linear model: give a jq.TransferFunction or a jq.StateSpace"
            )
        motions, start = None, np.ones(count_states(model))
        measured = jnp.size(model.measure(model.init()))
        if measured != len(record.output_names):
            raise ValueError(
                Message(
                    f"the model measures {measured} outputs, the record has "
                    f"{', '.join(record.output_names)}: «pick channels with jq.records.select»"
                )
            )
    else:
        plant = linear_model(model)
        check_channels(plant, record)
        check_growth(plant, record)
        motions, start = unknown_motions(plant, record.duration)[:2], np.zeros(0)
    y = band_filter(np.asarray(record.outputs), gain)
    weights = 1 / np.std(y, axis=0)
    return RecordTerm(u, y, weights, gain, motions, start, record.dt, between, feedback=feedback)


def _with_units(problem: OutputError) -> OutputError:
    """Initial states in units that each move the output by its own size, as far as they show."""
    if not problem.unknown:
        return problem
    count = problem.base.parameters.count
    z = np.concatenate([problem.base.parameters.start[:count], np.zeros(problem.unknown)])
    slopes = evaluate_misfits(z, problem).slopes
    terms, at = [], count
    for term, by_record in zip(problem.terms, slopes, strict=True):
        mine = np.asarray(by_record)[:, :, at : at + term.start.size]
        sizes = np.sqrt(np.mean(mine**2, axis=(0, 1)))
        if not np.all(np.isfinite(sizes)):
            raise ValueError(
                "the model cannot be integrated over the record from its starting values: it "
                "diverges or is too stiff. Start from other values, or cut the record with "
                "jq.records.trim"
            )
        shows = sizes > 1e-6 * np.max(sizes, initial=0.0)
        start = np.where(shows, 1 / np.where(shows, sizes, 1.0), 0.0)
        terms.append(dataclasses.replace(term, start=start))
        at += term.start.size
    return dataclasses.replace(problem, terms=tuple(terms))
