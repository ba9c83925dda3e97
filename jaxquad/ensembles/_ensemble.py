from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Key

from jaxquad._core import check_positive
from jaxquad.identify import Fit
from jaxquad.models import DecoupledAxes, Multirotor
from jaxquad.simulation import Drive, Encoder

from ._distributions import as_law, Law, law_or_none, number
from ._draw import drawn_members, SAMPLINGS
from ._members import Members, Payload
from ._posterior import builder, Fitted, fitted
from ._variation import axes_of, FACTORS, own_value, plant_inertia, QUANTITIES


_UNITS = {
    "torque_gain": "times the plant's",
    "told": "times the true inertia",
    "lag": "s",
    "delay": "s",
    "damping": "N m s/rad",
    "stiffness": "N m/rad",
    "coulomb": "N m",
    "noise": "rad, standard deviation",
    "gust": "N m, standard deviation",
    "payload added": "times the plant's inertia, in flight",
    "payload at": "s",
    "payload width": "s",
}


def ensemble_text(ensemble: Any) -> str:
    """What varies, how and in which unit; then what is the same in all members."""
    laws = ensemble.laws
    varies = {name: law for name, law in laws.items() if law.varies}
    same = {name: law for name, law in laws.items() if name not in varies and _says(name, law)}
    kind, axes = type(ensemble.plant).__name__, ensemble.axes
    lines = [f"ensemble of a {kind} of {axes} {'axes' if axes > 1 else 'axis'}"]
    lines += [f"  {ensemble.fitted}"] if ensemble.fitted is not None else []
    lines += [_line(name, law, ensemble) for name, law in varies.items()]
    lines += [_line(name, law, ensemble) for name, law in same.items()]
    lines += [f"  {part}" for part in _hardware(ensemble)]
    return "\n".join(lines)


def _says(name: str, law: Law) -> bool:
    """Whether a fixed quantity is worth a line: a factor of 1 is not."""
    return not (name in FACTORS and np.all(law.support[0] == 1))


def _line(name: str, law: Law, ensemble: Any) -> str:
    unit = _UNITS.get(name, "")
    if name == "inertia":
        unit = f"times {number(plant_inertia(ensemble.plant))} kg m^2"
    alone = ", each axis by itself" if name in ensemble.independent else ""
    return f"  {name:<14} {law.text:<32} {unit}{alone}"


def _hardware(ensemble: Any) -> list[str]:
    corner = f"gusts of {ensemble.gust_corner:.4g} rad/s" if ensemble.gust is not None else None
    sampled = f"{ensemble.sampling} sampling, loop of {1e3 * ensemble.dt:.4g} ms"
    parts = [x for x in (ensemble.drive, ensemble.encoder) if x is not None]
    return [", ".join(x for x in (sampled, corner, *(type(p).__name__ for p in parts)) if x)]


_POSITIVE = {
    "inertia": "factors of the plant's inertia",
    "torque_gain": "factors of the plant's torque gain",
    "told": "factors of the true inertia",
    "lag": "s; for motors without lag leave it None",
    "payload width": "s; None lasts to the end",
}
_NOT_NEGATIVE = {
    "delay": "s",
    "coulomb": "N m; friction acts against the motion",
    "noise": "rad, a standard deviation",
    "gust": "N m, a standard deviation",
    "payload at": "s from the start",
}
_ONE_FOR_ALL = ("delay", "payload at", "payload width")  # axes
_OF_ROTORS = ("torque_gain", "lag")  # of a multirotor: they act on all axes alike


def check_ensemble(ensemble: Any) -> None:
    """Raise ValueError for an ensemble that cannot be drawn."""
    check_plant(ensemble.plant)
    check_positive(dt=ensemble.dt, gust_corner=ensemble.gust_corner)
    if not (ensemble.payload is None or isinstance(ensemble.payload, Payload)):
        raise ValueError(
            f"payload is {ensemble.payload!r}: give a jq.ensembles.Payload(added, at=...)"
        )
    laws = ensemble.laws
    _check_names(ensemble, laws)
    for name, law in laws.items():
        _check_axes(name, law, ensemble)
        _check_support(name, law)
    _check_carried(ensemble, laws)


def check_request(n: int, key: Key[Array, ""]) -> None:
    """Raise ValueError for a draw of no members, or without a key."""
    if isinstance(n, bool) or not isinstance(n, int | np.integer) or n < 1:
        raise ValueError(f"n is {n}: draw a whole number of members, 1 or more")
    if not (isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)):
        raise ValueError(f"key is {key!r}: give a jax.random.key(0)")


def check_plant(plant: Any) -> None:
    if not isinstance(plant, DecoupledAxes | Multirotor):
        raise ValueError(
            f"an Ensemble is of a jq.DecoupledAxes or jq.models.Multirotor, not of {type(plant).__name__}:"
            " for an identified model use jq.Ensemble.from_fit(fit, ...)"
        )
    shape = plant.shape[1:] if isinstance(plant, DecoupledAxes) else plant.ensemble
    if shape:
        raise ValueError(
            f"the plant already is an ensemble of {shape}: give one plant, and say as laws what "
            "varies"
        )


def _check_axes(name: str, law: Law, ensemble: Any) -> None:
    sizes = {x.size for x in law.support} - {1}
    rotors = isinstance(ensemble.plant, Multirotor) and name in _OF_ROTORS
    if (name in _ONE_FOR_ALL or rotors) and (sizes or name in ensemble.independent):
        raise ValueError(f"{name} is one for all axes: give it a law of single numbers")
    if sizes and sizes != {ensemble.axes}:
        raise ValueError(
            f"the law of {name} is for {max(sizes)} axes, but the plant has {ensemble.axes}: give "
            "one number for all axes, or one for each"
        )


def _check_support(name: str, law: Law) -> None:
    least = float(np.min(law.support[0]))
    if name in _POSITIVE and not least > 0:
        raise ValueError(
            f"{name} is {law.text}, which reaches {least:.4g}, but it must stay above 0 "
            f"({_POSITIVE[name]}): narrow the law, or take a jq.ensembles.LogUniform or jq.ensembles.LogNormal"
        )
    if name in _NOT_NEGATIVE and not least >= 0:
        raise ValueError(
            f"{name} is {law.text}, which reaches {least:.4g}, but it cannot be negative "
            f"({_NOT_NEGATIVE[name]}): narrow the law"
        )


def _check_carried(ensemble: Any, laws: dict[str, Law]) -> None:
    if ensemble.payload is None:
        return
    least = [laws[name].support[0] for name in ("inertia", "payload added")]
    if not sum(np.min(x) for x in least) > 0:
        raise ValueError(
            f"a payload of {number(least[1])} times the plant's inertia leaves none of the "
            f"{number(least[0])} that a member can have: set down less"
        )


def _check_names(ensemble: Any, laws: dict[str, Law]) -> None:
    if ensemble.sampling not in SAMPLINGS:
        raise ValueError(f"sampling is {ensemble.sampling!r}: use one of {', '.join(SAMPLINGS)}")
    if ensemble.sampling == "grid" and ensemble.fitted is not None:
        raise ValueError('a fit has no grid to draw on: use sampling="latin"')
    known = [name for name, law in laws.items() if law.varies]
    given = ensemble.independent
    if isinstance(given, str) or any(name not in known for name in given):
        raise ValueError(
            f"independent is {given!r}: name quantities that vary, in brackets; here "
            f"{', '.join(known) or 'none does'}"
        )


_FRESH = 0x5EED  # folded into the key of members that judge what was tuned on others

Given = Law | ArrayLike | Sequence[Any]


class Ensemble(eqx.Module):
    """What is known of a plant and its loop, and how far it is open.

    Each quantity is a number or a law: `jq.ensembles.Uniform`, `jq.ensembles.LogUniform`, `jq.ensembles.Normal`, `jq.ensembles.LogNormal`,
    `jq.ensembles.Choice`, with one set of numbers for all axes or one for each. `inertia` and `torque_gain`
    are factors of the plant's, `told` is the inertia that a scheduled controller is told over the
    true one; the others have their own units, None leaves them as the plant has them, and a
    `Normal` without a mean is relative to what the plant has. All axes share what is drawn, except
    for the quantities named in `independent`. `sampling` is "latin" (hypercube), "random", "sobol"
    or "grid" (as many levels of each). `dt` is the loop's sample interval.

        ensemble = jq.Ensemble(
            jq.DecoupledAxes([0.0468], [0.0552]),
            inertia=jq.ensembles.LogUniform(0.5, 3.0), torque_gain=jq.ensembles.Normal(0.05), told=jq.ensembles.Normal(0.1),
            lag=jq.ensembles.Uniform(0.01, 0.04), delay=0.004, coulomb=0.002, noise=np.radians(0.02),
            drive=jq.simulation.Saturation(10.0),
        )
        members = ensemble.draw(64, jax.random.key(0))

    Source: EQUATIONS.md, section 3. Raises ValueError for laws that hold what cannot be, such as an
    inertia or lag that is not positive or a negative delay.
    """

    plant: DecoupledAxes | Multirotor
    inertia: Law = eqx.field(converter=as_law, default=1.0, kw_only=True)
    torque_gain: Law = eqx.field(converter=as_law, default=1.0, kw_only=True)
    told: Law = eqx.field(converter=as_law, default=1.0, kw_only=True)
    lag: Law | None = eqx.field(converter=law_or_none, default=None, kw_only=True)  # s
    delay: Law | None = eqx.field(converter=law_or_none, default=None, kw_only=True)  # s, None: 0
    damping: Law | None = eqx.field(converter=law_or_none, default=None, kw_only=True)  # N m s/rad
    stiffness: Law | None = eqx.field(converter=law_or_none, default=None, kw_only=True)  # N m/rad
    coulomb: Law | None = eqx.field(converter=law_or_none, default=None, kw_only=True)  # N m
    noise: Law | None = eqx.field(converter=law_or_none, default=None, kw_only=True)  # rad
    gust: Law | None = eqx.field(converter=law_or_none, default=None, kw_only=True)  # N m
    gust_corner: float = eqx.field(static=True, default=2.0, kw_only=True)  # rad/s
    payload: Payload | None = eqx.field(default=None, kw_only=True)
    drive: Drive | None = eqx.field(default=None, kw_only=True)
    encoder: Encoder | None = eqx.field(default=None, kw_only=True)
    sampling: str = eqx.field(static=True, default="latin", kw_only=True)
    independent: tuple[str, ...] = eqx.field(static=True, default=(), kw_only=True)
    dt: float = eqx.field(static=True, default=0.002, kw_only=True)  # s
    fitted: Fitted | None = eqx.field(default=None, kw_only=True)  # what `from_fit` draws from

    def __check_init__(self):
        check_ensemble(self)

    @property
    def axes(self) -> int:
        """Of the plant."""
        return axes_of(self.plant)

    @property
    def laws(self) -> dict[str, Law]:
        """The law of each quantity that has one: factors, and the others in their own units."""
        given = {name: getattr(self, name) for name in QUANTITIES}
        if self.payload is not None:
            given |= {f"payload {name}": x for name, x in vars(self.payload).items()}
        named = {name: law for name, law in given.items() if law is not None}
        own = lambda name: None if self.fitted is not None else own_value(self.plant, name)
        return {
            name: law if name in FACTORS else law.about(own(name), name)
            for name, law in named.items()
        }

    @classmethod
    def from_fit(
        cls,
        fit: Fit,
        *,
        recorded_dt: float | None,
        believed: ArrayLike | None = None,
        plant: Callable[[Any], Any] | None = None,
        inertia: Given = 1.0,
        torque_gain: Given = 1.0,
        told: Given = 1.0,
        lag: Given | None = None,
        delay: Given | None = None,
        damping: Given | None = None,
        stiffness: Given | None = None,
        coulomb: Given | None = None,
        noise: Given | None = None,
        gust: Given | None = None,
        gust_corner: float = 2.0,
        payload: Payload | None = None,
        drive: Drive | None = None,
        encoder: Encoder | None = None,
        sampling: str = "latin",
        independent: tuple[str, ...] = (),
        dt: float = 0.002,
    ) -> "Ensemble":
        """Plants and delays drawn from what a `fit` leaves open, and further spreads on top.

        Known are `jq.models.AttitudeAxis`, `jq.LaggedIntegrator` (b = K, from command to rate or angle in
        rad) and a `jq.TransferFunction` of that form; for other models `plant` makes the pair
        (jq.DecoupledAxes, delay in s) of one. `believed` is the inertia in kg m^2 that goes with
        the gain where the fit determines only b = KT / J: torques in N m and the inertia told refer
        to it. The factors (`inertia=jq.ensembles.LogUniform(0.5, 3.0)`) multiply what is drawn; the laws of
        the others replace it. The inertia told is the believed, or fitted, one times its factors.

        `recorded_dt` is the sample interval of the record whose input was held from sample to
        sample: half of it is in the identified delay and is taken off, down to 0, since a simulated
        loop holds its inputs itself. None for an input that was not held, and for a fit by
        `jq.refine(..., hold="zero")`, which holds it too.

        Raises NotIdentifiable where a plant would change with what the record does not determine,
        ValueError for a fit that found no minimum and for models that it does not know.
        """
        if recorded_dt is not None:
            check_positive(recorded_dt=recorded_dt)
        check_positive(dt=dt)
        build = builder(fit.model, believed, plant)
        laws = {"lag": lag, "delay": delay, "damping": damping, "stiffness": stiffness}
        replaced = tuple(
            name for name, law in {**laws, "coulomb": coulomb}.items() if law is not None
        )
        drawn = fitted(fit, build, recorded_dt=recorded_dt, dt=dt, replaced=replaced)
        return cls(
            build(fit.model)[0], inertia=inertia, torque_gain=torque_gain, told=told, lag=lag,
            delay=delay, damping=damping, stiffness=stiffness, coulomb=coulomb, noise=noise,
            gust=gust, gust_corner=gust_corner, payload=payload, drive=drive, encoder=encoder,
            sampling=sampling, independent=independent, dt=dt, fitted=drawn,
        )  # fmt: skip

    def draw(self, n: int, key: Key[Array, ""]) -> Members:
        """`n` members. The same key draws the same members, in either precision.

        Raises ValueError for fewer than one, and for a number that does not fill a grid.
        """
        check_request(n, key)
        return drawn_members(self, n, key, self.sampling)

    def fresh(self, n: int, key: Key[Array, ""]) -> Members:
        """`n` members to judge by, which have nothing to do with those of `draw` for the same key.

        Nor with each other: whatever the sampling, they are drawn at random, so that shares of them
        are binomial.
        """
        check_request(n, key)
        return drawn_members(self, n, jax.random.fold_in(key, _FRESH), "random")

    def __str__(self) -> str:
        return ensemble_text(self)
