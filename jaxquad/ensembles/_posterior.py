"""Plants drawn from a fit, and whether the record determines what they depend on."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from jaxquad._core import as_float, is_zero, require_positive
from jaxquad.identify import check_drawable, draw_models, Fit, known_covariance, NotIdentifiable
from jaxquad.models import AttitudeAxis, DecoupledAxes, LaggedIntegrator, TransferFunction

from ._distributions import scores
from ._draw import unit_points


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


_LOST = 0.01  # share of a variance that may lie in directions which are not drawn
_LOOKED_AT = 1024  # draws by which the longest delay is judged


class Fitted(eqx.Module):
    """The plants and delays that a fit leaves open."""

    fit: Fit
    build: Build = eqx.field(static=True)
    held_back: float = eqx.field(static=True)  # s, of the delay, which the loop adds by itself
    longest: float = eqx.field(static=True)  # s
    dt: float = eqx.field(static=True)  # s, of the loop

    @property
    def deviates(self) -> int:
        """How many normal numbers a draw takes."""
        return len(self.fit.names)

    def plants(
        self, deviates: Float[np.ndarray, "parameters members"]
    ) -> tuple[DecoupledAxes, Float[np.ndarray, "1 members"], float]:
        """Plants, their delays in s, and the longest that counts for their loop."""
        plant, delay = drawn_plants(self.fit, self.build, jnp.asarray(deviates))
        _check_positive(plant)
        delay = np.maximum(np.asarray(delay) - self.held_back, 0.0)
        longest = max(self.longest, whole_samples_above(delay, self.dt))
        return plant, delay[None], longest

    def __str__(self) -> str:
        names = ", ".join(self.fit.names)
        held = ""
        if not self.fit.identifiable:
            held = f"; {', '.join(self.fit.identifiability.undetermined)} vary only in what counts"
        return f"drawn from the covariance of a fit of {names}{held}"


def fitted(
    fit: Fit, build: Build, *, recorded_dt: float | None, dt: float, replaced: tuple[str, ...]
) -> Fitted:
    """A fit to draw from; `replaced` are the plant's quantities that laws replace.

    Raises NotIdentifiable where a plant changes with what the record does not determine.
    """
    check_drawable(fit, hold_undetermined=True)
    require_determined(fit, build, replaced)
    held_back = 0.0 if recorded_dt is None else recorded_dt / 2
    start = Fitted(fit, build, held_back, 0.0, dt)
    points = unit_points("latin", jax.random.key(0), start.deviates, _LOOKED_AT)
    return Fitted(fit, build, held_back, start.plants(scores(points))[2], dt)


def drawn_plants(
    fit: Fit, build: Build, deviates: Float[Array, "parameters members"]
) -> tuple[DecoupledAxes, Float[Array, " members"]]:
    """[axes, members] in every parameter of the plant."""
    models = draw_models(fit, deviates, hold_undetermined=True)
    place = lambda drawn, one: -1 if eqx.is_array(drawn) and drawn.ndim > one.ndim else None
    axes = jax.tree.map(place, models, fit.model)
    each = eqx.filter_vmap(build, in_axes=(axes,), out_axes=-1, axis_size=deviates.shape[1])
    return eqx.filter_jit(each)(models)


def whole_samples_above(delay: Float[np.ndarray, "..."], dt: float) -> float:
    """The longest `delay` in s, up to whole samples, so that other draws have the same."""
    return float(np.ceil(np.max(delay) / dt - 1e-9)) * dt


def require_determined(fit: Fit, build: Build, replaced: tuple[str, ...]) -> None:
    """Raise NotIdentifiable where a quantity changes with undetermined directions of the fit."""
    here = jnp.asarray(fit._fitted())

    def numbers(values: Array) -> dict[str, Array]:
        plant, delay = build(fit.parameters.replace(fit.model, values))
        parts = {name: x for name, x in vars(plant).items() if x is not None} | {"delay": delay}
        return {name: jnp.ravel(x) for name, x in parts.items() if name not in replaced}

    if fit.identifiable:
        return
    slopes = {n: np.asarray(s) * fit.units for n, s in jax.jacfwd(numbers)(here).items()}
    moved = [numbers(jnp.asarray(values)) for values in fit.identifiability.alternatives]
    fixed, lost = numbers(here), []
    for name, slope in slopes.items():
        jumps = [not np.allclose(other[name], fixed[name], rtol=1e-6, atol=0) for other in moved]
        if any(jumps) or any(_depends(fit, row) for row in slope):
            lost.append(name)
    if lost:
        raise NotIdentifiable(_refusal(fit, lost))


def _depends(fit: Fit, slope: Float[np.ndarray, " parameters"]) -> bool:
    verdict, size = fit.identifiability, np.linalg.norm(slope)
    if np.any(np.abs(verdict.exact @ slope) > 1e-6 * size):
        return True
    if any(slope[fit.names.index(name)] != 0 for name in verdict.curved):
        return True
    keep = np.eye(len(slope)) - verdict.exact.T @ verdict.exact
    whole = slope @ keep @ fit.relative_covariance @ keep @ slope
    drawn = slope @ known_covariance(fit) @ slope
    return bool(whole - drawn > _LOST * whole + 1e-12 * size**2)


def _refusal(fit: Fit, lost: list[str]) -> str:
    remedies = []
    if {"inertia", "torque_gain"} & set(lost):
        remedies.append("believed=, an inertia in kg m^2, if b = KT / J is determined")
    replaceable = [name for name in lost if name not in ("inertia", "torque_gain")]
    if replaceable:
        remedies.append(f"a law instead, {replaceable[0]}=jq.ensembles.Uniform(low, high)")
    undetermined = ", ".join(fit.identifiability.undetermined)
    return (
        f"the plant's {', '.join(lost)} would change with what the record does not determine "
        f"({undetermined}): give {'; or '.join(remedies)}; or fit under a jq.identify.Prior or with a "
        "second record"
    )


def _check_positive(plant: DecoupledAxes) -> None:
    for name, value in vars(plant).items():
        if value is None or name not in ("torque_gain", "inertia", "lag"):
            continue
        values = np.asarray(value)
        wrong = int(np.sum(np.any(~(values > 0), axis=0)))
        if wrong:
            raise ValueError(
                f"{name} is not above 0 in {wrong} of {values.shape[-1]} plants drawn from the "
                f"fit, the least is {np.min(values):.4g}: fit it by its bare name, which keeps its "
                "sign, or with more excitation"
            )
