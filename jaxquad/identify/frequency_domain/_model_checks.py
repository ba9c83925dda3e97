"""Models of a user's own: what a fit cannot use is refused before it is traced."""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

from jaxquad.models import LaggedIntegrator, StateSpace, TransferFunction
from jaxquad.spectra import FrequencyResponse


def require_model(function: str, model: object) -> None:
    """Raise ValueError for what is no model to start from."""
    if isinstance(model, type):
        raise ValueError(
            f"{function} needs a model with the values to start from, not the class "
            f"{model.__name__}: give {model.__name__}(...)"
        )
    if not isinstance(model, eqx.Module) or isinstance(model, FrequencyResponse):
        raise ValueError(
            f"{function} needs a model to start from, such as jq.LaggedIntegrator(gain, lag, "
            f"delay), not a {type(model).__name__}; it comes first: jq.{function}(model, data)"
        )


_FEW = 5  # frequencies of the trial
_OURS = (LaggedIntegrator, StateSpace, TransferFunction)
_sound: set[tuple] = set()  # what was tried before


def require_model_response(model: PyTree, frf: FrequencyResponse) -> None:
    """Raise ValueError for a model whose response is none of this shape, or is not complex."""
    if isinstance(model, _OURS):
        return
    leaves, structure = jax.tree.flatten(model)
    kind = (structure, tuple(map(np.shape, leaves)), frf.response.shape[1:])
    if kind not in _sound:
        _require_shape(model, frf)
        _sound.add(kind)


def _require_shape(model: PyTree, frf: FrequencyResponse) -> None:
    name = f"{type(model).__name__}.frequency_response(omega)"
    respond = getattr(model, "frequency_response", None)
    if respond is None:
        raise ValueError(f"{type(model).__name__} has no frequency_response(omega) to fit: add it")
    omega = jax.ShapeDtypeStruct((_FEW,), np.float64)
    try:
        found = eqx.filter_eval_shape(lambda model, w: model.frequency_response(w), model, omega)
    except jax.errors.TracerArrayConversionError as error:
        raise ValueError(
            f"{name} computes with NumPy, which has no derivatives: use jax.numpy in it"
        ) from error
    shape, pairs = np.shape(found), frf.response.shape[1:]
    alone = shape == (_FEW,) and pairs == (1, 1)
    if not alone and shape != (_FEW, *pairs):
        raise ValueError(
            f"{name} has the shape {shape} for {_FEW} frequencies, but the measured response has "
            f"{pairs[0]} outputs and {pairs[1]} inputs: return {(_FEW, *pairs)}"
            f"{f' or ({_FEW},)' if pairs == (1, 1) else ''}"
        )
    if not np.issubdtype(found.dtype, np.complexfloating):
        raise ValueError(f"{name} is real: return complex numbers, with magnitude and phase")
