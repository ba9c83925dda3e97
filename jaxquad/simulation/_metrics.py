"""The numbers of a flight or an ensemble of flights, and their table."""

import dataclasses
from typing import NamedTuple, TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxquad.records import AXES


if TYPE_CHECKING:
    import xarray


NUMBERS = (
    "itae", "iae", "ise", "overshoot", "rise_time", "settling_time", "settling_time_5", "peak",
    "rms", "disturbance_rmse", "activity", "energy", "saturation_share",
)  # fmt: skip
_TIMES = ("rise_time", "settling_time", "settling_time_5")


class Spread(NamedTuple):
    """One number over an ensemble; inf where it rests on members that never get there.

    **Arguments:**

    - `mean`: over the members.
    - `p95`: their 95 % quantile.
    - `worst`: of them.
    - `cvar20`: mean of the worst fifth.
    """

    mean: Float[Array, " axes"]
    p95: Float[Array, " axes"]
    worst: Float[Array, " axes"]
    cvar20: Float[Array, " axes"]


class Summary(eqx.Module):
    """The numbers of `Metrics` over all members, those that diverged among them.

    `summary.itae.mean` and so on, each with one value per axis.
    """

    itae: Spread
    iae: Spread
    ise: Spread
    overshoot: Spread
    rise_time: Spread
    settling_time: Spread
    settling_time_5: Spread
    peak: Spread
    rms: Spread
    disturbance_rmse: Spread
    activity: Spread
    energy: Spread
    saturation_share: Spread
    diverged_share: Float[Array, ""]
    members: int = eqx.field(static=True)


def summarise(metrics: "Metrics") -> Summary:
    """`Metrics.summary`. A time that a member never reaches counts as infinite."""
    spreads = {}
    for name in NUMBERS:
        values = vars(metrics)[name]
        if name in _TIMES:
            never = metrics.stepped & jnp.isnan(values)
            values = jnp.where(never, jnp.inf, values)
        spreads[name] = spread_of(values)
    share = jnp.mean(metrics.diverged.astype(metrics.itae.dtype))
    return Summary(**spreads, diverged_share=share, members=metrics.diverged.size)


def spread_of(values: Float[Array, " axes *ensemble"]) -> Spread:
    """Mean, 95 % quantile, maximum and CVaR20 of each axis. nan members make the result nan."""
    members = jnp.sort(values.reshape(values.shape[0], -1), axis=1)
    spread = (quantile(members, 0.95), members[:, -1], cvar(members, 0.2))
    unknown = jnp.isnan(members[:, -1])  # sorted to the end
    return Spread(jnp.mean(members, axis=1), *(jnp.where(unknown, jnp.nan, x) for x in spread))


def quantile(ordered: Float[Array, " axes members"], share: float) -> Float[Array, " axes"]:
    """Of rising values, interpolated as numpy does; inf as soon as it rests on one."""
    place = share * (ordered.shape[1] - 1)
    below, part = int(place), place - int(place)
    low, high = ordered[:, below], ordered[:, min(below + 1, ordered.shape[1] - 1)]
    finite = jnp.isfinite(high) | (part == 0)
    step = jnp.where(finite, high, 0) - jnp.where(finite, low, 0)
    return jnp.where(finite, low + part * step, high)


def cvar(ordered: Float[Array, " axes members"], share: float) -> Float[Array, " axes"]:
    """Mean of the worst `share` of rising values: the next one counts in part, so none is lost."""
    members = ordered.shape[1]
    count = share * members
    parts = jnp.clip(count - jnp.arange(members, dtype=ordered.dtype), 0, 1)[::-1] / count
    counted: Bool[Array, " members"] = parts > 0
    weighed = jnp.where(counted[None], parts[None] * jnp.where(counted[None], ordered, 0), 0)
    return jnp.sum(weighed, axis=1)


class Metrics(eqx.Module):
    """How well a loop did in a window of time, for each axis and each member of an ensemble.

    The error is the reference less the true angle. `str()` shows one loop as it is, and an ensemble
    by mean, 95 % quantile, worst and CVaR20. A member that has diverged, in the window or not, is
    evaluated with its angle held where it left the bound: `diverged` says so, its integrals are
    finite, and it never settles.
    The step goes from where the reference stands before the window (with a window from 0 s, from
    the first angle) to where it is when the window ends or the load begins. Overshoot, rise and
    settling are nan on an axis whose reference does not go from one value to another and stay
    there; the rise time also if 90 % is never reached, a settling time if the angle is outside
    the band at the end. Times are interpolated between samples, so that they have gradients.

    **Arguments:**

    - `itae`: integral of (t - start) |error|, rad s^2; `iae`: of |error|, rad s; `ise`: of error^2,
        rad^2 s.
    - `overshoot`: % of the step, 0 if there is none.
    - `rise_time`: s, from 10 to 90 % of the step.
    - `settling_time`, `settling_time_5`: s, to within 2 % and 5 % of the step for good.
    - `peak`, `rms`: greatest |error| and its root mean square under load, rad.
    - `disturbance_rmse`: root mean square error of its estimate under load, N m; nan without one.
    - `activity`: sum of squared changes of the command; `energy`: integral of its square, unit^2 s.
    - `saturation_share`: of the samples.
    - `step`: rad, from first to last, 0 without one; `stepped`: whether the reference makes one.
    - `diverged`: whether the member left the bound.
    - `beyond_authority`: share of samples with a disturbance that the drive cannot hold; nan if
        that is not known. `reversing`: share of samples at which motors turn backwards.
    - `start`, `stop`, `load_start`: s, of the window and of the load in it.
    - `per_step`: whether the integrals are divided by the step.
    """

    itae: Float[Array, " axes *ensemble"]
    iae: Float[Array, " axes *ensemble"]
    ise: Float[Array, " axes *ensemble"]
    overshoot: Float[Array, " axes *ensemble"]
    rise_time: Float[Array, " axes *ensemble"]
    settling_time: Float[Array, " axes *ensemble"]
    settling_time_5: Float[Array, " axes *ensemble"]
    peak: Float[Array, " axes *ensemble"]
    rms: Float[Array, " axes *ensemble"]
    disturbance_rmse: Float[Array, " axes *ensemble"]
    activity: Float[Array, " axes *ensemble"]
    energy: Float[Array, " axes *ensemble"]
    saturation_share: Float[Array, " axes *ensemble"]
    step: Float[Array, " axes *ensemble"]
    stepped: Bool[Array, " axes *ensemble"]
    diverged: Bool[Array, "*ensemble"]
    beyond_authority: Float[Array, " axes *ensemble"]
    reversing: Float[Array, " axes *ensemble"]
    start: float = eqx.field(static=True)
    stop: float = eqx.field(static=True)
    load_start: float = eqx.field(static=True)
    per_step: bool = eqx.field(static=True, default=False)

    def normalised(self) -> "Metrics":
        """The same with ITAE, IAE and ISE of a unit step; nan on axes without a step."""
        if self.per_step:
            return self
        size = jnp.where(self.stepped, jnp.abs(self.step), jnp.nan)
        integrals = {"itae": self.itae / size, "iae": self.iae / size, "ise": self.ise / size**2}
        return dataclasses.replace(self, **integrals, per_step=True)

    def summary(self) -> Summary:
        """Mean, 95 % quantile, worst and CVaR20 of every number over the ensemble."""
        return summarise(self)

    def to_xarray(self) -> "xarray.Dataset":
        """Every number with its dimensions `axis` and `member`, for xarray (extra `interop`).

        Each variable has its unit in `attrs`, the dataset the window in s.
        """
        return _labelled(self, axis_names(self.itae.shape[0]))

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a reader has to know before using the numbers."""
        return tuple(remarks(self))

    def __str__(self) -> str:
        return described(self)


if TYPE_CHECKING:
    from ._metrics import Metrics


_NOTHING = 1e-9  # in every unit of the table
_DEGREE = float(np.degrees(1.0))
# Field, title, unit and factor of the absolute number, unit and factor of that of a unit step.
_ROWS = (
    ("itae", "ITAE", ("deg s^2", _DEGREE), ("s^2", 1.0)),
    ("iae", "IAE", ("deg s", _DEGREE), ("s", 1.0)),
    ("ise", "ISE", ("deg^2 s", _DEGREE**2), ("s", 1.0)),
    ("overshoot", "overshoot", ("%", 1.0), None),
    ("rise_time", "rise time", ("s", 1.0), None),
    ("settling_time", "settling time 2 %", ("s", 1.0), None),
    ("settling_time_5", "settling time 5 %", ("s", 1.0), None),
    ("peak", "peak error", ("deg", _DEGREE), None),
    ("rms", "rms error", ("deg", _DEGREE), None),
    ("disturbance_rmse", "disturbance error", ("N m", 1.0), None),
    ("activity", "activity", ("", 1.0), None),
    ("energy", "energy", ("", 1.0), None),
    ("saturation_share", "saturated", ("%", 100.0), None),
)
_STATISTICS = (("mean", "mean"), ("p95", "p95"), ("worst", "worst"), ("cvar20", "CVaR20"))


def described(metrics: "Metrics") -> str:
    """A table of one loop, or one for each axis of an ensemble, and the remarks."""
    names = axis_names(metrics.itae.shape[0])
    members = metrics.diverged.size
    head = f"metrics, {metrics.start:.6g} .. {metrics.stop:.6g} s"
    if metrics.load_start != metrics.start:
        head += f", under load from {metrics.load_start:.6g} s"
    if metrics.per_step:
        head += ", integrals of a unit step"
    if metrics.diverged.ndim:
        head += f", {members} member{'s' * (members > 1)}"
        table = _ensemble_tables(metrics, names)
    else:
        values = [np.asarray(vars(metrics)[row[0]]) for row in _ROWS]
        table = _table("", list(names), values, metrics.per_step)
    return "\n".join([head, *table, *(f"  ! {remark}" for remark in remarks(metrics))])


def axis_names(count: int) -> tuple[str, ...]:
    return AXES[:count] if count <= len(AXES) else tuple(f"axis {k}" for k in range(count))


def _ensemble_tables(metrics: "Metrics", names: tuple[str, ...]) -> list[str]:
    summary, lines, still = metrics.summary(), [], at_rest(metrics)
    for k, name in enumerate(names):
        if still[k]:
            lines.append(f"  {name}: at rest")
            continue
        values = []
        for row in _ROWS:
            spread = vars(summary)[row[0]]._asdict()
            values.append(np.array([spread[field][k] for field, _ in _STATISTICS]))
        lines += _table(name, [title for _, title in _STATISTICS], values, metrics.per_step)
    return lines


def at_rest(metrics: "Metrics") -> np.ndarray:
    """Axes in which nothing happens."""
    names = ("itae", "activity", "energy")
    moved = [np.nan_to_num(_flat(vars(metrics)[name])).any(axis=1) for name in names]
    return ~np.any(moved, axis=0)


def _table(name: str, columns: list[str], values: list[np.ndarray], per_step: bool) -> list[str]:
    lines = [f"  {name:<28}" + "".join(f"{column:>11}" for column in columns)]
    for (_, title, absolute, relative), numbers in zip(_ROWS, values, strict=True):
        unit, scale = relative if per_step and relative is not None else absolute
        texts = "".join(f"{_text(x * scale):>11}" for x in numbers)
        lines.append(f"  {title:<19}{unit:<9}{texts}")
    return lines


def _text(x: float) -> str:
    if np.isnan(x):
        return "-"
    return "never" if np.isinf(x) else f"{x if abs(x) > _NOTHING else 0:.4g}"


def remarks(metrics: "Metrics") -> list[str]:
    """Why a number is missing, who diverged, and what the drive cannot do."""
    names, texts = axis_names(metrics.itae.shape[0]), []
    count, members = int(np.sum(metrics.diverged)), metrics.diverged.size
    if count:
        who = f"{count} of {members} members ({count / members:.1%})" if members > 1 else "the loop"
        texts.append(f"{who} diverged: the numbers count its angle as held where it left the bound")
    stepped = _flat(metrics.stepped)
    missing = ~stepped.any(axis=1) & ~at_rest(metrics)
    without = [name for name, there in zip(names, missing, strict=True) if there]
    if without:
        texts.append(
            f"{', '.join(without)}: the reference makes no step that it holds, hence no "
            "overshoot, rise or settling"
        )
    for field, what in (
        ("rise_time", "does not reach 90 % of the step"),
        ("settling_time", "is outside 2 % of the step at the end"),
    ):
        never = np.isnan(_flat(vars(metrics)[field])) & stepped
        of_many = never.shape[1] > 1
        for name, share in zip(names, never.mean(axis=1), strict=True):
            if share:
                who = f"{name}: {share:.1%} of the members: the angle" if of_many else name
                texts.append(f"{who} {what}")
    if np.isnan(np.asarray(metrics.disturbance_rmse)).all():
        texts.append(
            "no error of the disturbance estimate: the controller makes none, or the plant's "
            "torque per unit of command is not known (give torque_gain)"
        )
    for field, what in (
        ("beyond_authority", "exceed the torque of the drive"),
        ("reversing", "need motors that turn backwards"),
    ):
        shares = np.nan_to_num(_flat(vars(metrics)[field])).mean(axis=1)
        where = [f"{x:.1%} on {name}" for name, x in zip(names, shares, strict=True) if x]
        if where:
            texts.append(f"disturbances {what}: samples {', '.join(where)}")
    return texts


def _flat(values: ArrayLike) -> np.ndarray:
    array = np.asarray(values)
    return array.reshape(array.shape[0], -1)


_UNITS = {
    "itae": "rad s^2", "iae": "rad s", "ise": "rad^2 s", "overshoot": "%", "rise_time": "s",
    "settling_time": "s", "settling_time_5": "s", "peak": "rad", "rms": "rad",
    "disturbance_rmse": "N m", "activity": "", "energy": "", "saturation_share": "1",
    "step": "rad", "stepped": "", "diverged": "", "beyond_authority": "1", "reversing": "1",
}  # fmt: skip
_OF_A_UNIT_STEP = {"itae": "s^2", "iae": "s", "ise": "s"}


def _labelled(metrics: "Metrics", axes: tuple[str, ...]) -> "xarray.Dataset":
    """`Metrics.to_xarray`, with names for the axes."""
    import xarray

    depth = metrics.diverged.ndim
    members = ("member",) if depth == 1 else tuple(f"member_{k}" for k in range(depth))
    units = _UNITS | (_OF_A_UNIT_STEP if metrics.per_step else {})
    variables = {}
    for name, unit in units.items():
        values = np.asarray(vars(metrics)[name])
        dims = members if name == "diverged" else ("axis", *members)
        variables[name] = (dims, values, {"units": unit} if unit else {})
    counts = {name: np.arange(n) for name, n in zip(members, metrics.diverged.shape, strict=True)}
    window = {name: vars(metrics)[name] for name in ("start", "stop", "load_start")}  # s
    return xarray.Dataset(variables, coords={"axis": list(axes), **counts}, attrs=window)
