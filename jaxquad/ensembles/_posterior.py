"""The plants that a fit leaves uncertain, and whether the record determines what they need."""

from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from jaxquad._core import as_float, is_zero, on_host, require_all_positive, require_positive
from jaxquad.identify import (
    check_drawable,
    draw_models,
    Fit,
    HasTransferFunction,
    known_covariance,
    UndeterminedError,
)
from jaxquad.loops import Plant
from jaxquad.models import (
    AttitudeAxis,
    DecoupledAxes,
    DiscreteTransferFunction,
    LaggedIntegrator,
    TransferFunction,
)

from ._distributions import draw_unit_points, normal_scores


Number = Float[ArrayLike, ""]
Build = Callable[[PyTree], tuple[DecoupledAxes, Number]]  # the plant, and the delay in s
Given = Callable[[PyTree], tuple[DecoupledAxes, ArrayLike]]


def make_plant(
    model: PyTree, *, believed: ArrayLike | None = None
) -> tuple[DecoupledAxes, Float[Array, ""]]:
    """Make the plant of a loop from an identified model of one axis.

    **Arguments:**

    - `model`: a `jq.models.AttitudeAxis`, a `jq.LaggedIntegrator`, a `jq.TransferFunction` of that
        form, or an own model whose method `transfer_function()` returns one.
    - `believed`: the inertia in kg m^2 that belongs to the gain b = KT / J, if the model has none.

    **Returns:**

    The plant, and the delay of the model in s.

    **Raises:**

    - `ValueError`: the model is of another form, or `believed` is missing or not above 0.
    """
    plant, delay = _choose_builder(model, believed, None)(model)
    return plant, as_float(delay)


def _choose_builder(model: PyTree, believed: ArrayLike | None, plant: Given | None) -> Build:
    """How plants are made of models like this one. Raise ValueError where that is not known."""
    if plant is not None:
        if believed is not None:
            raise ValueError(
                "give plant= or believed=, not both: the function plant= sets the inertia itself"
            )

        def build_given(model: PyTree) -> tuple[DecoupledAxes, Array]:
            pair = plant(model)
            if not (
                isinstance(pair, tuple) and len(pair) == 2 and isinstance(pair[0], DecoupledAxes)
            ):
                raise ValueError(
                    f"plant(model) returned {type(pair).__name__}, but it must return a pair: "
                    "(jq.DecoupledAxes(...), delay in s)"
                )
            return pair[0], as_float(pair[1])

        return build_given
    if believed is not None:
        believed = on_host(as_float(believed))
        require_positive("believed", believed, "the inertia in kg m^2 that the gain belongs to")
        if believed.ndim:
            raise ValueError(
                f"believed is {believed}: give one number, the axis's inertia in kg m^2"
            )
    if isinstance(model, AttitudeAxis):
        lagging = not is_zero(model.lag)

        def build_axis(m: AttitudeAxis) -> tuple[DecoupledAxes, Number]:
            # With a believed inertia it depends on b = L K_t / J_x and on K_af / J_x alone.
            inertia = m.J_x if believed is None else believed
            share, lag = inertia / m.J_x, m.lag if lagging else None
            gain, damping = share * m.L * m.K_t, share * m.K_af
            return DecoupledAxes(gain, inertia, lag=lag, damping=damping), m.delay

        return build_axis
    if not isinstance(model, TransferFunction | HasTransferFunction):
        raise ValueError(
            f"a {type(model).__name__} cannot be converted into a plant: give plant=, a "
            "function of the model that returns (jq.DecoupledAxes(...), delay in s), or give the "
            "model a method transfer_function() that returns K / (s (lag s + 1)) to the rate"
        )
    if believed is None:
        raise ValueError(
            f"a {type(model).__name__} has the gain b = KT / J, but no inertia: give believed=, "
            "the inertia in kg m^2 that torques and scheduled controllers refer to"
        )
    if isinstance(model, LaggedIntegrator):
        return _of_integrator(model, believed)
    if isinstance(model, TransferFunction):
        return _of_transfer_function(model, believed)
    build = _of_transfer_function(model.transfer_function(), believed)
    return lambda m: build(m.transfer_function())


def _of_integrator(model: LaggedIntegrator, believed: Number) -> Build:
    if model.integrators not in (1, 2):
        raise ValueError(
            f"the model has {model.integrators} integrators: an axis has 1 from command to rate, "
            "or 2 to angle; for another one give plant="
        )
    lagging = not is_zero(model.lag)

    def build(m: LaggedIntegrator) -> tuple[DecoupledAxes, Number]:
        lag = m.lag if lagging else None
        plant = DecoupledAxes(m.gain * believed, believed, lag=lag, damping=m.damping * believed)
        return plant, m.delay

    return build


def _of_transfer_function(
    model: TransferFunction | DiscreteTransferFunction, believed: Number
) -> Build:
    if not isinstance(model, TransferFunction):
        raise ValueError("the model is discrete: give plant=, or convert it, model.to_continuous()")
    denominator = np.asarray(model.denominator)
    integrators = int(np.argmax(denominator[::-1] != 0))
    order = denominator.size - 1 - integrators
    if model.numerator.size != 1 or integrators not in (1, 2) or order > 1:
        raise ValueError(
            f"the transfer function {np.asarray(model.numerator)} / {denominator} is not "
            "K / (s (lag s + 1)) to a rate or K / (s^2 (lag s + 1)) to an angle: give plant="
        )

    def build(m: TransferFunction) -> tuple[DecoupledAxes, Number]:
        lag = m.denominator[0] / m.denominator[1] if order else None
        gain = m.numerator[0] / m.denominator[order]
        return DecoupledAxes(gain * believed, believed, lag=lag), m.delay

    return build


def _unmodelled_delay(fit: Fit, recorded_dt: float | None | Literal["as fitted"]) -> float:
    """Half of a hold that the fit does not model, in s. Raise ValueError where nobody said."""
    holds = [] if fit.origin is None else [frf.hold for frf in fit.origin.frfs]
    modelled = bool(holds) and None not in holds
    if recorded_dt == "as fitted":
        if modelled:
            return 0.0
        raise ValueError(
            "the fit does not know how long the command was held, so its delay may hold half of "
            "it: fit a record that says so (jq.Record(..., hold=dt)), or give recorded_dt=, the "
            "sample interval in s of a command held from sample to sample, None if it was not held"
        )
    if recorded_dt is None:
        return 0.0
    require_all_positive(recorded_dt=recorded_dt)
    if modelled:
        raise ValueError(
            f"recorded_dt is {recorded_dt:g} s, but the fit models the hold of the command "
            f"({holds[0]:g} s) already: leave recorded_dt out"
        )
    return recorded_dt / 2


_LOST = 0.01  # share of a variance that may lie in directions which are not drawn
_AT_ONCE = 256  # plants that are made together
_DRAWS = 1024  # by which the longest delay is found
_ROOM = 1.25  # over it: thousands of members hold longer ones, and need not be another program


class Posterior(eqx.Module):
    """The plants and delays that an identification leaves uncertain.

    It is the first argument of a `jq.Ensemble`, and has the nominal values for a `jq.Loop`.

    !!! example

        ```python
        posterior = jq.ensembles.Posterior(fit, believed=0.0552)
        loop = jq.Loop(posterior.plant, controller, delay=posterior.delay)
        ensemble = jq.Ensemble(posterior, inertia=jq.ensembles.LogUniform(0.5, 3.0))
        ```
    """

    fit: Fit
    plant: DecoupledAxes  # nominal: of the fitted model
    delay: float  # s, nominal
    build: Build = eqx.field(static=True)
    held_back: float = eqx.field(static=True)  # s, of the delay, which the loop adds by itself
    longest: float = eqx.field(static=True)  # s, of many draws
    band: tuple[float, float] | None = eqx.field(static=True)  # rad/s, that was identified
    largest_command: float | None = eqx.field(static=True)  # of the record, in its unit

    def __init__(
        self, fit: Fit, *, recorded_dt: float | None | Literal["as fitted"] = "as fitted",
        believed: ArrayLike | None = None, plant: Given | None = None,
        band: tuple[float, float] | None = None, largest_command: float | None = None,
    ):  # fmt: skip
        """**Arguments:**

        - `fit`: of a `jq.models.AttitudeAxis`, a `jq.LaggedIntegrator` (b = K, from the command to
            rate or angle in rad), a `jq.TransferFunction` of that form, an own model whose
            `transfer_function()` is one, or, with `plant`, of any other model.
        - `recorded_dt`: needed where the record did not say how long its input is held
            (`Record.hold`): the sample interval in s if it is held from sample to sample, None if
            it is not held. Half of a hold that the fit does not model is in the identified delay
            and is subtracted, down to 0, since a simulated loop holds its inputs itself.
        - `believed`: the inertia in kg m^2 that belongs to the gain, where the fit determines only
            b = KT / J: torques in N m and the inertia given to a scheduled controller refer to it.
        - `plant`: a function of the model that returns the pair (`jq.DecoupledAxes`, delay in s).
        - `band`: the frequencies in rad/s that were fitted: a certificate says where a bandwidth
            lies beyond them.
        - `largest_command`: how far the record's command went to either side, in its unit: a
            certificate says where a drive's limit exceeds it.

        **Raises:**

        - `ValueError`: the fit found no minimum or has no finite errors, its model is not known,
            or `recorded_dt` is missing, or given for a fit that models the hold.
        """
        if not isinstance(fit, Fit):
            raise ValueError(f"fit is a {type(fit).__name__}: give the result of jq.fit")
        self.held_back = _unmodelled_delay(fit, recorded_dt)
        check_drawable(fit, hold_undetermined=True)
        if band is not None and not 0 < band[0] < band[1]:
            raise ValueError(f"band is {band} rad/s: give (low, high), 0 < low < high")
        if largest_command is not None:
            require_all_positive(largest_command=largest_command)
        self.band, self.largest_command = band, largest_command
        self.fit, self.build = fit, _choose_builder(fit.model, believed, plant)
        self.plant, delay = self.build(on_host(fit.model) if plant is None else fit.model)
        self.delay = float(np.maximum(np.asarray(delay) - self.held_back, 0.0))
        points = draw_unit_points("latin", jax.random.key(0), self.deviates, _DRAWS)
        self.longest = float(np.max(self._drawn(normal_scores(points))[1]))

    @property
    def deviates(self) -> int:
        """How many normal numbers a draw takes."""
        return len(self.fit.names)

    def draw(
        self, scores: Float[np.ndarray, "parameters members"], dt: float
    ) -> tuple[DecoupledAxes, Float[np.ndarray, "1 members"], float]:
        """Plants, their delays in s, and the longest that a loop of this `dt` reckons with."""
        plant, delay = self._drawn(scores)
        # Up to whole samples, so that other draws have the same.
        longest = max(_ROOM * self.longest, float(np.max(delay)))
        return plant, delay[None], float(np.ceil(longest / dt - 1e-9)) * dt

    def _drawn(
        self, scores: Float[np.ndarray, "parameters members"]
    ) -> tuple[DecoupledAxes, Float[np.ndarray, " members"]]:
        """[axes, members] in every parameter; equally many at a time, by one program."""
        count, parts = scores.shape[1], []
        for first in range(0, count, _AT_ONCE):
            some = scores[:, first : first + _AT_ONCE]
            padded = np.pad(some, ((0, 0), (0, _AT_ONCE - some.shape[1])))
            models = draw_models(self.fit, padded, hold_undetermined=True)
            parts.append(_build_plants(self.build, models, self.fit.model, _AT_ONCE))
        join = lambda *parts: np.concatenate(parts, axis=-1)[..., :count]
        plant, delay = jax.tree.map(join, *parts)
        for name, value in vars(plant).items():
            if value is None or name not in ("torque_gain", "inertia", "lag"):
                continue
            values = np.asarray(value)
            wrong = int(np.sum(np.any(~(values > 0), axis=0)))
            if wrong:
                raise ValueError(
                    f"{name} is not above 0 in {wrong} of {values.shape[-1]} plants drawn from the "
                    f"fit, the least is {np.min(values):.4g}: name it without jq.identify.Real in "
                    "free=, which keeps its sign, or record more excitation"
                )
        return plant, np.maximum(delay - self.held_back, 0.0)

    def require_nominal(self, plant: Plant) -> None:
        """Raise ValueError unless `plant` is what the draws are around."""
        center = self.plant
        if not (
            isinstance(plant, DecoupledAxes)
            and plant.shape == center.shape
            and np.allclose(plant.inertia, center.inertia)
            and np.allclose(plant.torque_gain, center.torque_gain)
        ):
            raise ValueError(
                "the plant of the loop is not the one that was identified: give "
                "jq.Loop(posterior.plant, controller, delay=posterior.delay)"
            )

    def require_determined(self, replaced: tuple[str, ...]) -> None:
        """Raise UndeterminedError where a quantity changes with undetermined parameters.

        Quantities that are `replaced` by distributions do not count.
        """
        if self.fit.identifiable:
            return
        here = jnp.asarray(self.fit.values)

        def numbers(values: Array) -> dict[str, Array]:
            plant, delay = self.build(self.fit.parameters.replace(self.fit.model, values))
            parts = {name: x for name, x in vars(plant).items() if x is not None} | {"delay": delay}
            return {name: jnp.ravel(x) for name, x in parts.items() if name not in replaced}

        slopes = {n: np.asarray(s) * self.fit.units for n, s in jax.jacfwd(numbers)(here).items()}
        moved = [numbers(jnp.asarray(values)) for values in self.fit.verdict.alternatives]
        fixed, lost = numbers(here), []
        for name, slope in slopes.items():
            jumps = [
                not np.allclose(other[name], fixed[name], rtol=1e-6, atol=0) for other in moved
            ]
            if any(jumps) or any(_depends(self.fit, row) for row in slope):
                lost.append(name)
        if not lost:
            return
        remedies = []
        if {"inertia", "torque_gain"} & set(lost):
            remedies.append("believed=, an inertia in kg m^2, if b = KT / J is determined")
        replaceable = [name for name in lost if name not in ("inertia", "torque_gain")]
        if replaceable:
            remedies.append(
                f"a distribution instead, {replaceable[0]}=jq.ensembles.Uniform(low, high)"
            )
        undetermined = ", ".join(self.fit.verdict.undetermined)
        raise UndeterminedError(
            f"the plant's {', '.join(lost)} would change with parameters that the record does not "
            f"determine ({undetermined}): give {'; or '.join(remedies)}; or fit with a "
            "jq.identify.Prior or a second record"
        )

    def __str__(self) -> str:
        names = ", ".join(self.fit.names)
        remark = ""
        if not self.fit.identifiable:
            undetermined = ", ".join(self.fit.verdict.undetermined)
            remark = f"; of {undetermined} only what the record determines varies"
        return f"drawn from the covariance of a fit of {names}{remark}"


@eqx.filter_jit
def _build_plants(
    build: Build, models: PyTree, one: PyTree, count: int
) -> tuple[DecoupledAxes, Float[Array, " members"]]:
    place = lambda drawn, one: -1 if eqx.is_array(drawn) and drawn.ndim > one.ndim else None
    axes = jax.tree.map(place, models, one)
    return eqx.filter_vmap(build, in_axes=(axes,), out_axes=-1, axis_size=count)(models)


def _depends(fit: Fit, slope: Float[np.ndarray, " parameters"]) -> bool:
    verdict, size = fit.verdict, np.linalg.norm(slope)
    if np.any(np.abs(verdict.exact @ slope) > 1e-6 * size):
        return True
    if any(slope[fit.names.index(name)] != 0 for name in verdict.curved):
        return True
    keep = np.eye(len(slope)) - verdict.exact.T @ verdict.exact
    variance = slope @ keep @ fit.relative_covariance @ keep @ slope
    drawn = slope @ known_covariance(fit) @ slope
    return bool(variance - drawn > _LOST * variance + 1e-12 * size**2)
