from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array, ArrayLike, Key

from jaxquad.excitation._checks import check_positive
from jaxquad.identify import Fit
from jaxquad.models import DecoupledAxes, Multirotor
from jaxquad.simulate import Encoder
from jaxquad.simulate._protocols import Drive

from ._draw import drawn_members
from ._ensemble_checks import check_ensemble, check_request
from ._ensemble_text import ensemble_text
from ._fit_plants import builder
from ._fitted import Fitted, fitted
from ._law import as_law, Law, law_or_none
from ._members import Members
from ._payload import Payload
from ._variation import axes_of, FACTORS, own_value, QUANTITIES


_FRESH = 0x5EED  # folded into the key of members that judge what was tuned on others

Given = Law | ArrayLike | Sequence[Any]


class Ensemble(eqx.Module):
    """What is known of a plant and its loop, and how far it is open.

    Each quantity is a number or a law: `jq.Uniform`, `jq.LogUniform`, `jq.Normal`, `jq.LogNormal`,
    `jq.Choice`, with one set of numbers for all axes or one for each. `inertia` and `torque_gain`
    are factors of the plant's, `told` is the inertia that a scheduled controller is told over the
    true one; the others have their own units, None leaves them as the plant has them, and a
    `Normal` without a mean is relative to what the plant has. All axes share what is drawn, except
    for the quantities named in `independent`. `sampling` is "latin" (hypercube), "random", "sobol"
    or "grid" (as many levels of each). `dt` is the loop's sample interval.

        ensemble = jq.Ensemble(
            jq.DecoupledAxes([0.0468], [0.0552]),
            inertia=jq.LogUniform(0.5, 3.0), torque_gain=jq.Normal(0.05), told=jq.Normal(0.1),
            lag=jq.Uniform(0.01, 0.04), delay=0.004, coulomb=0.002, noise=np.radians(0.02),
            drive=jq.Saturation(10.0),
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

        Known are `jq.AttitudeAxis`, `jq.LaggedIntegrator` (b = K, from command to rate or angle in
        rad) and a `jq.TransferFunction` of that form; for other models `plant` makes the pair
        (jq.DecoupledAxes, delay in s) of one. `believed` is the inertia in kg m^2 that goes with
        the gain where the fit determines only b = KT / J: torques in N m and the inertia told refer
        to it. The factors (`inertia=jq.LogUniform(0.5, 3.0)`) multiply what is drawn; the laws of
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
