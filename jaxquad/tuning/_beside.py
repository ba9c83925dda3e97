"""What stands beside a design in its certificate; a tune evaluates it while it descends."""

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from jaxquad._core import thread_settings
from jaxquad.control import Reference
from jaxquad.ensembles import Ensemble, Members
from jaxquad.loops import Loop
from jaxquad.simulation import asked_devices, may_be_several, Scenario

from ._design_result import DesignResult
from ._evaluate_design import evaluate_design
from ._problem import DeviceChoice, require_same_rate, TimeSpan


class Beside(NamedTuple):
    """Designs on the members of a certificate, beside which another one stands."""

    drawn: Members
    flight: Scenario  # with the members' noise
    peers: dict[str, DesignResult]
    idle: DesignResult  # the command 0
    start: DesignResult | None  # where a tuning started


class _Idle(eqx.Module):
    """The controller that does nothing."""

    def init(self, like: Float[Array, " axes *ensemble"]) -> None:
        """It remembers nothing."""
        return None

    def step(
        self, state: None, reference: Reference, measurement: Float[Array, " axes *ensemble"]
    ) -> tuple[None, Float[Array, " axes *ensemble"]]:
        """The command 0."""
        return None, jnp.zeros_like(measurement)


def evaluate_beside(
    loop: Loop,
    ensemble: Ensemble | Members,
    scenario: Scenario,
    key: Key[Array, ""],
    *,
    peers: Mapping[str, PyTree],
    begun: PyTree | None,
    members: int,
    span: TimeSpan,
    devices: DeviceChoice,
) -> Beside:
    """Draw the members of a certificate, and evaluate all designs but that which is certified."""
    # Independent draws, as the bound of a share needs.
    given = isinstance(ensemble, Members)
    drawn = ensemble if given else ensemble.fresh(loop, members, key)
    require_same_rate(loop, drawn)
    flight = drawn.flight(scenario)
    run = lambda design: evaluate_design(design, drawn, flight, span, devices)
    start = None if begun is None else run(begun)
    return Beside(drawn, flight, {n: run(x) for n, x in peers.items()}, run(_Idle()), start)


def begin_evaluating(
    evaluate: Callable[[], Beside],
    devices: DeviceChoice,
    *,
    before: Callable[[], None] = lambda: None,
) -> Callable[[], Beside]:
    """Begin in a thread, whose programs are compiled while others are; the function waits for it.

    The thread calls `before` first: what it compiles there, the caller needs before the result.
    With several devices, and where JAX is set differently for the caller's thread alone, the
    function itself evaluates.
    """
    if may_be_several(asked_devices(devices)):
        return evaluate
    pool, settings = ThreadPoolExecutor(1), thread_settings()

    def run() -> Beside | None:
        if thread_settings() != settings:
            return None
        before()
        return evaluate()

    begun: Future[Beside | None] = pool.submit(run)
    pool.shutdown(wait=False)

    def wait() -> Beside:
        found = begun.result()
        return evaluate() if found is None else found

    return wait
