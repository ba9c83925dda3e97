import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from ._authority import Authority, find_authority, warn_beyond_authority
from ._check_loop import check_loop
from ._loop import scan_loop
from ._protocols import Controller, Drive, Plant
from ._sample import SampleResult
from ._scenario import Scenario
from ._sensor import Encoder
from ._settings import loop_settings, Settings
from ._simulation import Simulation


def simulate(
    plant: Plant,
    controller: Controller,
    scenario: Scenario,
    *,
    dt: float = 0.002,
    drive: Drive | None = None,
    encoder: Encoder | None = None,
    delay: Float[ArrayLike, "*ensemble"] = 0.0,
    longest_delay: float | None = None,
    substeps: int = 1,
    bound: float = 100.0,
) -> Simulation:
    """Run a sampled-data loop: measure, control, hold the inputs for `dt` seconds, repeat.

    Between samples the plant is integrated by `substeps` fourth-order Runge-Kutta steps under
    constant inputs. The injected signal is added to the controller's command, so that a sweep can
    excite a plant that needs stabilising; `drive` makes motor inputs of the sum, as `jq.Multirotor`
    needs. The inputs reach the plant `delay` seconds later, exactly: any delay of 0 or above, whole
    samples or not, one for all or one per member. Under jit, vmap or grad with respect to the
    delay, `longest_delay` says how long it can become.

    One loop, or an ensemble along the last axis of the plant's parameters, of the controller's
    gains, of the scenario, of the delay, or of several of them. A member whose angle leaves
    +-`bound` rad, or whose numbers grow beyond 1e9, is held there and flagged in `diverged`, so
    that values and gradients of the others, and its own, stay finite.

    Raises `ValueError` for parts that do not fit together, such as a controller made for another
    `dt`, ensembles of different sizes or a payload that the plant cannot carry.
    """
    settings = loop_settings(
        dt=dt, drive=drive, encoder=encoder, delay=delay, longest_delay=longest_delay,
        substeps=substeps, bound=bound,
    )  # fmt: skip
    check_loop(plant, controller, scenario, settings)
    (angle, *others), running, authority = _run(plant, controller, scenario, settings)
    warn_beyond_authority(authority, scenario)
    time = jnp.asarray(dt * np.arange(angle.shape[0]), angle.dtype)
    measurement, command, saturated, signals = others
    return Simulation(
        time=time,
        angle=angle,
        measurement=measurement,
        command=command,
        saturated=saturated,
        signals=signals,
        diverged=~running,
        scenario=scenario,
        dt=dt,
        authority=authority,
    )


@eqx.filter_jit
def _run(
    plant: Plant, controller: Controller, scenario: Scenario, settings: Settings
) -> tuple[PyTree, Bool[Array, "*ensemble"], Authority | None]:
    _, stored, running = scan_loop(plant, controller, scenario, settings, _keep, lambda like: None)
    return stored, running, find_authority(plant, settings.drive, controller)


def _keep(nothing: None, now: SampleResult) -> tuple[None, PyTree]:
    return nothing, (now.angle, now.measurement, now.command, now.saturated, now.signals)
