"""Sums of a flight, sample by sample: only those that are wanted."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxquad.simulate import Authority
from jaxquad.simulate._meter import divisor, wide


_SOFTNESS = 0.005  # of the limit, about which a command counts as saturated in part


class Span(NamedTuple):
    """The samples that count, as `jaxquad.simulate._window.Window`, but known before."""

    first: int
    last: int
    loaded: int
    until: int


class Steps(NamedTuple):
    """Of the parts of a flight between events: where the reference goes, for overshoot."""

    target: Float[Array, "parts axes ..."]  # rad, where the reference ends
    before: Float[Array, "parts axes ..."]  # rad, where it was before
    known: Bool[Array, "parts axes ..."]  # whether it is a step


class Accumulate(eqx.Module):
    """Adds up what `wanted` quantities need: to be given to a loop, with `begin`."""

    wanted: tuple[str, ...] = eqx.field(static=True)
    span: Span = eqx.field(static=True)
    dt: float = eqx.field(static=True)
    events: tuple[float, ...] = eqx.field(static=True)  # s, when the clock of ITAE starts again
    parts: tuple[tuple[int, int], ...] = eqx.field(static=True)  # samples from and to, of `steps`
    steps: Steps
    authority: Authority | None

    def begin(self, like: Float[Array, " axes *ensemble"]) -> dict[str, Array]:
        names = list(self.wanted) + ["command"] * ("activity" in self.wanted)
        return {name: jnp.zeros_like(like) for name in names}

    def update(self, sums: dict[str, Array], now: Any) -> tuple[dict[str, Array], None]:
        """One sample more; `now` is a `SampleResult`."""
        inside = (now.index >= self.span.first) & (now.index <= self.span.last)
        after = {name: getattr(self, f"_{name}")(sums, now) for name in sums}
        return jax.tree.map(lambda new, old: jnp.where(inside, new, old), after, sums), None

    def finished(self, sums: dict[str, Array]) -> dict[str, Array]:
        """The quantities of what was added up."""
        span = self.span
        counted, loaded = span.last - span.first + 1, span.last - span.loaded + 1
        shares = {"saturation_share": counted, "rms": loaded, "disturbance_rmse": loaded}
        found = {name: x / shares.get(name, 1) for name, x in sums.items() if name != "command"}
        for name in {"rms", "disturbance_rmse"} & found.keys():
            found[name] = jnp.sqrt(jnp.maximum(found[name], 1e-30))
        return found

    def _itae(self, sums, now):
        return sums["itae"] + self._weight(now) * self._elapsed(now) * jnp.abs(_error(now))

    def _iae(self, sums, now):
        return sums["iae"] + self._weight(now) * jnp.abs(_error(now))

    def _ise(self, sums, now):
        return sums["ise"] + self._weight(now) * _error(now) ** 2

    def _energy(self, sums, now):
        return sums["energy"] + self.dt * now.command**2

    def _activity(self, sums, now):
        change = jnp.where(now.index == self.span.first, 0, now.command - sums["command"])
        return sums["activity"] + change**2

    def _command(self, sums, now):
        return now.command

    def _overshoot(self, sums, now):
        target, before, known = (wide(x[0], now.angle) for x in self.steps)
        for k, (first, _) in enumerate(self.parts[1:], 1):
            later = (wide(x[k], now.angle) for x in self.steps)
            held = zip((target, before, known), later, strict=True)
            target, before, known = (jnp.where(now.index >= first, b, a) for a, b in held)
        beyond = 100 * ((now.angle - before) / divisor(target - before) - 1)
        counts = known & (now.index <= self.parts[-1][1])
        return jnp.where(counts, jnp.maximum(sums["overshoot"], beyond), sums["overshoot"])

    def _peak(self, sums, now):
        return jnp.maximum(sums["peak"], jnp.where(self._loaded(now), jnp.abs(_error(now)), 0))

    def _rms(self, sums, now):
        return sums["rms"] + jnp.where(self._loaded(now), _error(now) ** 2, 0)

    def _disturbance_rmse(self, sums, now):
        if self.authority is None or "disturbance" not in now.signals:
            return jnp.full_like(now.angle, jnp.nan)
        gain = wide(self.authority.torque_gain, now.angle)
        missed = gain * now.signals["disturbance"] - now.disturbance
        return sums["disturbance_rmse"] + jnp.where(self._loaded(now), missed**2, 0)

    def _saturation_share(self, sums, now):
        if self.authority is None:
            return sums["saturation_share"] + now.saturated.astype(now.angle.dtype)
        limit = wide(self.authority.command, now.angle)
        known = jnp.isfinite(limit)
        used = jnp.abs(now.command) / jnp.where(known, limit, 1)
        share = jax.nn.sigmoid((used - (1 - 2 * _SOFTNESS)) / (0.4 * _SOFTNESS))
        return sums["saturation_share"] + jnp.where(known, share, 0)

    def _loaded(self, now):
        return now.index >= self.span.loaded

    def _weight(self, now):
        # The trapezoidal rule, as `Meter`.
        at_end = (now.index == self.span.first) | (now.index == self.span.last)
        return jnp.where(at_end, 0.5 * self.dt, self.dt).astype(now.angle.dtype)

    def _elapsed(self, now):
        """s since the last event."""
        since = now.index - self.span.first
        for event in self.events:
            at = round(event / self.dt)
            since = jnp.where(now.index >= at, jnp.minimum(since, now.index - at), since)
        return since.astype(now.angle.dtype) * self.dt


def _error(now: Any) -> Array:
    return now.reference - now.angle
