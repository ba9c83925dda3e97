"""Section 5.3, Figures 6 and 7: the inertia from the flight, and b0 after it."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxquad as jq

from .loops import (
    DT,
    END,
    INERTIA,
    LEVER,
    rig,
    SHEET,
    START,
    WC,
    WO,
)


PAPER = 0.0517  # kg m^2, where Figure 6 settles
FIRST = PAPER * END / START  # kg m^2, which makes b0 = 3 and 1.6 of one rule b0 J^ = constant
DURATION = 40.0  # s
DRAWS = 16  # of gusts and noise
GAIN = np.array([2 * LEVER])  # N m per volt on each of two motors
MAP = jq.control.certainty_equivalence(END * INERTIA, INERTIA)  # 1.6 for the manual's inertia


class Flight(NamedTuple):
    """The rig held level under its test tone, and every estimator's inertia over time."""

    time: np.ndarray  # s
    inertia: dict[str, np.ndarray]  # kg m^2, [samples, draws], by estimator
    b0: np.ndarray  # [samples, draws]

    def errors(self, name: str) -> np.ndarray:
        """In per cent of the rig's inertia, each draw's median of the last 15 s."""
        settled = self.inertia[name][self.time >= DURATION - 15]
        return 100 * (np.median(settled, axis=0) / INERTIA - 1)


def estimators() -> dict[str, Any]:
    """The paper's and better ones, all from `FIRST`; the lock-in adds a permanent test tone."""
    start = np.array([FIRST])
    first = jq.control.WindowedInertia(GAIN, start, order=1, bandwidth=50.0, nuisance=(), dt=DT)
    third = jq.control.WindowedInertia(GAIN, start, dt=DT)
    lock_in = jq.control.LockInInertia(GAIN, start, jq.control.ProbeTones(above=0.0), dt=DT)
    return {
        "first-order observer": first,
        "third-order windows": third,
        "recursive": jq.control.RecursiveInertia(GAIN, start, dt=DT),
        "lock-in": lock_in,
    }


def fly(seed: int) -> Flight:
    """Encoder, 0.02 deg of noise and gusts of 5 mN m; the lock-in estimator adapts b0."""
    heard = estimators()
    happening = jq.scenario(
        duration=DURATION, dt=DT, axes=1, ensemble=DRAWS, disturbance=jq.simulation.Gust(0.005),
        noise=jq.simulation.WhiteNoise(np.radians(0.02)), key=jax.random.key(seed),
    )  # fmt: skip
    law = jq.AdaptiveLADRC(jq.LADRC(WC, WO, np.array([START]), dt=DT), heard["lock-in"], MAP)
    encoder = jq.simulation.Encoder(SHEET.encoder_counts)
    done = jq.simulate(jq.Loop(rig([2 * LEVER] * DRAWS), law, dt=DT, encoder=encoder), happening)
    before = jnp.concatenate([jnp.zeros_like(done.command[:1]), done.command[:-1]])
    inertia = {
        name: np.asarray(_listen(one, before, done.measurement))[:, 0]
        for name, one in heard.items()
    }
    return Flight(np.asarray(done.time), inertia, np.asarray(done.signals["b0"])[:, 0])


@eqx.filter_jit
def _listen(estimator, command, measurement):
    """The inertia, sample by sample, of an estimator that only listens."""

    def sample(state, now):
        state = estimator.update(state, *now)
        return state, estimator.estimate(state).inertia

    start = estimator.init(measurement[0])
    return jax.lax.scan(sample, start, (command, measurement))[1]
