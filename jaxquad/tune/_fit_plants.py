"""From identified models to plants with a delay; units of rad, and N m as the believed inertia."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from jaxquad.models import AttitudeAxis, DecoupledAxes, LaggedIntegrator, TransferFunction
from jaxquad.models._parameters import as_float, is_zero, require_positive


Build = Callable[[PyTree], tuple[DecoupledAxes, Array]]  # the plant, and the delay in s


def builder(
    model: PyTree, believed: ArrayLike | None, plant: Callable[[PyTree], Any] | None
) -> Build:
    """How plants are made of models like this one. Raises ValueError where that is not known."""
    if plant is not None:
        return _given(plant, believed)
    if believed is not None:
        believed = as_float(believed)
        require_positive("believed", believed, "the inertia in kg m^2 that the gain belongs to")
        if believed.ndim:
            raise ValueError(f"believed is {believed}: a fit of one axis has one inertia in kg m^2")
    if isinstance(model, AttitudeAxis):
        return lambda m: _of_axis(m, believed, lagging=not is_zero(model.lag))
    if not isinstance(model, LaggedIntegrator | TransferFunction):
        raise ValueError(
            f"a {type(model).__name__} is no axis of known form: give plant=, a function of the "
            "model that returns (jq.DecoupledAxes(...), delay in s)"
        )
    if believed is None:
        raise ValueError(
            f"a {type(model).__name__} knows the gain b = KT / J, but no inertia: give believed= "
            "in kg m^2, to which disturbances in N m and the inertia told to a controller belong"
        )
    if isinstance(model, LaggedIntegrator):
        return _of_integrator(model, believed)
    return _of_transfer_function(model, believed)


def _given(plant: Callable[[PyTree], Any], believed: ArrayLike | None) -> Build:
    if believed is not None:
        raise ValueError("believed is for models of known form: with plant= the function says J")

    def build(model: PyTree) -> tuple[DecoupledAxes, Array]:
        made = plant(model)
        if not (isinstance(made, tuple) and len(made) == 2 and isinstance(made[0], DecoupledAxes)):
            raise ValueError(
                f"plant(model) returned {type(made).__name__}, but it must return a pair: "
                "(jq.DecoupledAxes(...), delay in s)"
            )
        return made[0], as_float(made[1])

    return build


def _of_axis(
    model: AttitudeAxis, believed: Array | None, *, lagging: bool
) -> tuple[DecoupledAxes, Array]:
    """With a believed inertia the plant depends on b = L K_t / J_x and on K_af / J_x alone."""
    inertia = model.J_x if believed is None else believed
    share = inertia / model.J_x
    plant = DecoupledAxes(
        (share * model.L * model.K_t)[None],
        inertia[None],
        lag=model.lag[None] if lagging else None,
        damping=(share * model.K_af)[None],
    )
    return plant, model.delay


def _of_integrator(model: LaggedIntegrator, believed: Array) -> Build:
    if model.integrators not in (1, 2):
        raise ValueError(
            f"the model has {model.integrators} integrators: an axis has 1 from command to rate, "
            "or 2 to angle; for another one give plant="
        )
    lagging = not is_zero(model.lag)
    return lambda m: (_axis(m.gain, m.lag if lagging else None, believed), m.delay)


def _of_transfer_function(model: TransferFunction, believed: Array) -> Build:
    denominator = np.asarray(model.denominator)
    integrators = int(np.argmax(denominator[::-1] != 0))
    order = denominator.size - 1 - integrators
    if model.numerator.size != 1 or integrators not in (1, 2) or order > 1:
        raise ValueError(
            f"the transfer function {np.asarray(model.numerator)} / {denominator} is not "
            "K / (s (lag s + 1)) to a rate or K / (s^2 (lag s + 1)) to an angle: give plant="
        )

    def build(m: TransferFunction) -> tuple[DecoupledAxes, Array]:
        lag = m.denominator[0] / m.denominator[1] if order else None
        return _axis(m.numerator[0] / m.denominator[order], lag, believed), m.delay

    return build


def _axis(gain: Array, lag: Array | None, believed: Array) -> DecoupledAxes:
    lag = None if lag is None else lag[None]
    return DecoupledAxes((gain * believed)[None], believed[None], lag=lag)
