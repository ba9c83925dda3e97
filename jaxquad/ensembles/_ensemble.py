"""What varies between the members of an ensemble, and how they are drawn."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from jaxquad._core import as_float, ensemble_shape, multiply_gains, require_all_positive
from jaxquad.loops import Loop, Plant
from jaxquad.models import Multirotor

from ._distributions import (
    as_distribution,
    Distribution,
    distribution_or_none,
    draw_unit_points,
    make_grid,
    make_member_keys,
    normal_scores,
    number,
    SAMPLINGS,
)
from ._members import (
    count_axes,
    FACTORS,
    MemberPayload,
    Members,
    nominal_value,
    OF_PLANTS,
    Payload,
    plant_inertia,
    require_variable,
    UNCERTAIN,
    vary_plant,
)
from ._posterior import Posterior


_UNITS = {
    "inertia": "times the nominal",
    "torque_gain": "times the nominal",
    "assumed_inertia": "times the true inertia",
    "lag": "s",
    "delay": "s",
    "damping": "N m s/rad",
    "stiffness": "N m/rad",
    "coulomb": "N m",
    "noise": "rad, standard deviation",
    "gust": "N m, standard deviation",
    "payload added": "times the nominal inertia, in flight",
    "payload at": "s",
    "payload width": "s",
}


_POSITIVE = {
    "inertia": "factors of the plant's inertia",
    "torque_gain": "factors of the plant's torque gain",
    "assumed_inertia": "factors of the true inertia",
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


def _check_support(name: str, one: Distribution) -> None:
    least = float(np.min(one.support[0]))
    if name in _POSITIVE and not least > 0:
        raise ValueError(
            f"{name} is {one.text}, which reaches {least:.4g}, but it must stay above 0 "
            f"({_POSITIVE[name]}): narrow the distribution, or take a jq.ensembles.LogUniform or "
            "jq.ensembles.LogNormal"
        )
    if name in _NOT_NEGATIVE and not least >= 0:
        raise ValueError(
            f"{name} is {one.text}, which reaches {least:.4g}, but it cannot be negative "
            f"({_NOT_NEGATIVE[name]}): narrow the distribution"
        )


def _require_key(n: int, key: Key[Array, ""]) -> None:
    if isinstance(n, bool) or not isinstance(n, int | np.integer) or n < 1:
        raise ValueError(f"n is {n}: draw a whole number of members, 1 or more")
    if not (isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)):
        raise ValueError(f"key is {key!r}: give a jax.random.key(0)")


_FRESH = 0x5EED  # folded into the key of members that certify what was tuned on others


class Ensemble(eqx.Module):
    """What varies between the members of an ensemble; a `jq.Loop` holds what is nominal.

    Each quantity is a number or a distribution: `jq.ensembles.Uniform`, `jq.ensembles.LogUniform`,
    `jq.ensembles.Normal`, `jq.ensembles.LogNormal`, `jq.ensembles.Choice`, with one set of numbers
    for all axes or one for each. Quantities that are None stay nominal.

    !!! example

        ```python
        loop = jq.Loop(jq.DecoupledAxes([0.0468], [0.0552]), jq.LADRC(10.0, 30.0, 0.848),
                       drive=jq.simulation.Saturation(10.0), delay=0.004)
        ensemble = jq.Ensemble(
            inertia=jq.ensembles.LogUniform(0.5, 3.0), torque_gain=jq.ensembles.Normal(0.05),
            assumed_inertia=jq.ensembles.Normal(0.1), lag=jq.ensembles.Uniform(0.01, 0.04),
            coulomb=0.002, noise=np.radians(0.02),
        )
        members = ensemble.draw(loop, 64, jax.random.key(0))
        ```

    **Arguments:**

    - `plants`: plants and delays that an identification leaves uncertain; the other quantities act
        on top of these.
    - `inertia`, `torque_gain`: factors of the plant's.
    - `assumed_inertia`: the inertia that a scheduled controller assumes, over the true one.
    - `lag`: of the motors, in s.
    - `delay`: of the command, in s.
    - `damping`, `stiffness`, `coulomb`: N m s/rad, N m/rad and N m.
    - `noise`: standard deviation of the white noise on measured angles, in rad.
    - `gust`, `gust_corner`: standard deviation of a disturbance torque in N m, and the corner
        frequency of its spectrum in rad/s.
    - `payload`: inertia that members pick up in flight.
    - `sampling`: "latin" (hypercube), "random", "sobol" or "grid" (as many levels of each).
    - `independent`: quantities that are drawn for each axis by itself; all axes share the draws of
        the others.

    **Raises:**

    - `ValueError`: for distributions that reach what cannot be, such as an inertia or lag of 0 or
        a negative delay.
    - `jq.identify.UndeterminedError`: a plant would change with parameters that the record does not
        determine.
    """

    plants: Posterior | None = None
    inertia: Distribution = eqx.field(converter=as_distribution, default=1.0, kw_only=True)
    torque_gain: Distribution = eqx.field(converter=as_distribution, default=1.0, kw_only=True)
    assumed_inertia: Distribution = eqx.field(converter=as_distribution, default=1.0, kw_only=True)
    lag: Distribution | None = eqx.field(converter=distribution_or_none, default=None, kw_only=True)
    delay: Distribution | None = eqx.field(
        converter=distribution_or_none, default=None, kw_only=True
    )
    damping: Distribution | None = eqx.field(
        converter=distribution_or_none, default=None, kw_only=True
    )
    stiffness: Distribution | None = eqx.field(
        converter=distribution_or_none, default=None, kw_only=True
    )
    coulomb: Distribution | None = eqx.field(
        converter=distribution_or_none, default=None, kw_only=True
    )
    noise: Distribution | None = eqx.field(
        converter=distribution_or_none, default=None, kw_only=True
    )
    gust: Distribution | None = eqx.field(
        converter=distribution_or_none, default=None, kw_only=True
    )
    gust_corner: float = eqx.field(static=True, default=2.0, kw_only=True)  # rad/s
    payload: Payload | None = eqx.field(default=None, kw_only=True)
    sampling: str = eqx.field(static=True, default="latin", kw_only=True)
    independent: tuple[str, ...] = eqx.field(static=True, default=(), kw_only=True)

    def __check_init__(self):
        if not (self.plants is None or isinstance(self.plants, Posterior)):
            raise ValueError(
                f"plants is a {type(self.plants).__name__}: an ensemble says what varies, and the "
                "nominal plant belongs to jq.Loop(plant, controller). Give a "
                "jq.ensembles.Posterior(fit, ...), or only distributions, such as "
                "inertia=jq.ensembles.LogUniform(0.5, 3.0)"
            )
        if not (self.payload is None or isinstance(self.payload, Payload)):
            raise ValueError(
                f"payload is {self.payload!r}: give a jq.ensembles.Payload(added, at=...)"
            )
        require_all_positive(gust_corner=self.gust_corner)
        distributions = self.distributions
        if self.sampling not in SAMPLINGS:
            raise ValueError(f"sampling is {self.sampling!r}: use one of {', '.join(SAMPLINGS)}")
        if self.sampling == "grid" and self.plants is not None:
            raise ValueError('a posterior has no grid to draw on: use sampling="latin"')
        varying = [name for name, one in distributions.items() if one.varies]
        names = self.independent
        if isinstance(names, str) or any(name not in varying for name in names):
            raise ValueError(
                f"independent is {names!r}: name quantities that vary, in brackets; here "
                f"{', '.join(varying) or 'none does'}"
            )
        for name, one in distributions.items():
            if name in self.independent and name in _ONE_FOR_ALL:
                raise ValueError(f"{name} is the same for all axes: leave it out of independent=")
            if name in FACTORS or not one.relative:
                _check_support(name, one)
        if self.payload is not None:
            least = [distributions[name].support[0] for name in ("inertia", "payload added")]
            if not sum(np.min(x) for x in least) > 0:
                raise ValueError(
                    f"the payload adds {number(least[1])} and a member can start from "
                    f"{number(least[0])} times the nominal inertia, whose sum is not above 0: "
                    "remove less inertia"
                )
        if self.plants is not None:
            self.plants.require_determined(self.replaced)

    @property
    def distributions(self) -> dict[str, Distribution]:
        """The distribution of each quantity that has one."""
        fields = vars(self)
        named: dict[str, Distribution | None] = {name: fields[name] for name in UNCERTAIN}
        if self.payload is not None:
            named |= {f"payload {name}": x for name, x in vars(self.payload).items()}
        return {name: one for name, one in named.items() if one is not None}

    @property
    def replaced(self) -> tuple[str, ...]:
        """The plant's quantities that distributions replace."""
        names = ("lag", "delay", "damping", "stiffness", "coulomb")
        return tuple(name for name in names if name in self.distributions)

    def resolve(self, loop: Loop) -> tuple[Plant, dict[str, Distribution]]:
        """The nominal plant, and the distributions in SI units or as factors of nominal values.

        Raise ValueError for a loop that they do not fit.
        """
        if not isinstance(loop, Loop):
            raise ValueError(
                f"loop is a {type(loop).__name__}: give jq.Loop(plant, controller, ...)"
            )
        plant = loop.plant
        if not isinstance(plant, Plant):
            raise ValueError(
                f"the loop's plant is a {type(plant).__name__}, which lacks one of the methods "
                "init, derivative and measure: add it, see jq.loops.Plant. For an identified model "
                "use jq.Ensemble(jq.ensembles.Posterior(fit, ...))"
            )
        shape = ensemble_shape(plant)
        if shape or loop.delay.ndim:
            raise ValueError(
                f"the loop already is an ensemble of {shape or loop.delay.shape}: give one plant "
                "and one delay, and describe what varies by distributions"
            )
        if self.plants is not None:
            self.plants.require_nominal(plant)
        resolved = {}
        for name, one in self.distributions.items():
            sizes = {x.size for x in one.support} - {1}
            rotors = isinstance(plant, Multirotor) and name in _OF_ROTORS
            if sizes and (name in _ONE_FOR_ALL or rotors):
                raise ValueError(
                    f"{name} is the same for all axes: give it numbers, not rows of them"
                )
            if sizes and sizes != {count_axes(plant)}:
                raise ValueError(
                    f"the distribution of {name} is for {max(sizes)} axes, but the plant has "
                    f"{count_axes(plant)}: give one number for all axes, or one for each"
                )
            if name in self.independent and rotors:
                raise ValueError(f"{name} is the same for all axes: leave it out of independent=")
            varies = one.varies or name not in FACTORS or np.any(one.support[0] != 1)
            if varies and name in OF_PLANTS:
                require_variable(plant, name)
            resolved[name] = (
                one if name in FACTORS else one.about(self._nominal(loop, plant, name), name)
            )
            _check_support(name, resolved[name])
        return plant, resolved

    def _nominal(self, loop: Loop, plant: Plant, name: str) -> np.ndarray | None:
        if self.plants is not None:
            return None
        if name == "delay":
            return np.asarray(loop.delay) if np.any(np.asarray(loop.delay)) else None
        return nominal_value(plant, name)

    def draw(self, loop: Loop, n: int, key: Key[Array, ""]) -> Members:
        """Draw members to tune on.

        **Arguments:**

        - `loop`: what is nominal: plant, drive, encoder, delay and sample interval.
        - `n`: how many members.
        - `key`: the same key draws the same members, in single and in double precision.

        **Raises:**

        - `ValueError`: `n` is below 1, or does not fill a grid, or the loop does not fit.
        """
        _require_key(n, key)
        return self._draw(loop, n, key, self.sampling)

    def fresh(self, loop: Loop, n: int, key: Key[Array, ""]) -> Members:
        """Draw members to certify on, independent of those of `draw` for the same key.

        They are independent of each other, too: whatever the sampling, they are drawn at random,
        so that the number of them that fail is binomial.

        **Arguments:** and **Raises:** as for `draw`.
        """
        _require_key(n, key)
        return self._draw(loop, n, jax.random.fold_in(key, _FRESH), "random")

    def _draw(self, loop: Loop, n: int, key: Key[Array, ""], sampling: str) -> Members:
        nominal, distributions = self.resolve(loop)
        axes = count_axes(nominal)
        # How many numbers each distribution draws for a member.
        varying = {name: one for name, one in distributions.items() if one.varies}
        rows = {name: axes if name in self.independent else 1 for name in varying}
        # Probabilities: of the distributions first, then of the posterior.
        if sampling == "grid":
            points = make_grid([varying[name] for name in rows for _ in range(rows[name])], n)
        else:
            deviates = 0 if self.plants is None else self.plants.deviates
            points = draw_unit_points(sampling, key, sum(rows.values()) + deviates, n)
        drawn, first = {}, 0  # [axes] where it is known and [axes, members] where it varies
        for name, one in distributions.items():
            if not one.varies:
                drawn[name] = np.broadcast_to(one.support[0], (axes,))
                continue
            value = one.quantile(points[first : first + rows[name]])
            drawn[name] = np.broadcast_to(value, (axes, n))
            first += rows[name]
        wide = lambda x: np.broadcast_to(x if x.ndim > 1 else x[:, None], (axes, n))
        latest = lambda name: float(np.max(distributions[name].support[1]))
        plant, delay = nominal, np.atleast_1d(np.asarray(loop.delay))
        longest = loop.longest_delay or float(np.max(delay))
        if self.plants is not None:
            scores = normal_scores(points[sum(rows.values()) :])
            plant, delay, longest = self.plants.draw(scores, loop.dt)
        if "delay" in distributions:
            delay, longest = drawn["delay"], latest("delay")
        payload = None
        if "payload added" in distributions:
            inertia = wide(multiply_gains(plant_inertia(nominal), drawn["payload added"]))
            at, until = wide(drawn["payload at"])[0], np.full((n,), np.inf)
            if "payload width" in distributions:
                until = at + wide(drawn["payload width"])[0]
            parts = map(as_float, (inertia, at, until))
            payload = MemberPayload(*parts, latest=latest("payload at"))
        believed = multiply_gains(plant_inertia(nominal), drawn["inertia"])
        return Members(
            plant=vary_plant(plant, drawn),
            delay=as_float(wide(delay)[0]),
            assumed_inertia=as_float(wide(multiply_gains(believed, drawn["assumed_inertia"]))),
            keys=make_member_keys(key, n),
            noise=as_float(wide(drawn["noise"])) if "noise" in distributions else None,
            gust=as_float(wide(drawn["gust"])) if "gust" in distributions else None,
            payload=payload,
            drive=loop.drive,
            encoder=loop.encoder,
            longest_delay=longest,
            gust_corner=self.gust_corner,
            dt=loop.dt,
            substeps=loop.substeps,
            bound=loop.bound,
        )

    def __str__(self) -> str:
        varies = {name: one for name, one in self.distributions.items() if one.varies}
        same = {
            name: one
            for name, one in self.distributions.items()
            if name not in varies and not (name in FACTORS and np.all(one.support[0] == 1))
        }
        corner = f", gusts of {self.gust_corner:.4g} rad/s" if self.gust is not None else ""
        lines = [f"ensemble, {self.sampling} sampling{corner}"]
        lines += [f"  plants {self.plants}"] if self.plants is not None else []
        for name, one in (varies | same).items():
            relative = one.relative and name not in FACTORS
            unit = "times the nominal" if relative else _UNITS[name]
            alone = ", each axis by itself" if name in self.independent else ""
            lines.append(f"  {name:<15} {one.text:<32} {unit}{alone}")
        return "\n".join(lines)
