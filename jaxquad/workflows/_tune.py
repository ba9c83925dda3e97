"""`jaxquad tune`: from a fit of one axis to a tuned and certified controller."""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxquad.control import certainty_equivalence, LADRC, ScheduledLADRC
from jaxquad.ensembles import Ensemble, LogUniform, Normal
from jaxquad.export import write_c_header
from jaxquad.identify import Fit
from jaxquad.models import DecoupledAxes
from jaxquad.plot import certificate_figure, convergence_figure
from jaxquad.records import Record
from jaxquad.report import provenance, write_json, write_report
from jaxquad.simulation import Pulse, Saturation, Scenario, scenario, Step
from jaxquad.spectra import FrequencyResponse
from jaxquad.tuning import Limit, Objective, peers, Penalty, tune, Tuned


_PULSE, _BACK = 0.375, 0.625  # of the flight: when the torque comes, and the step back
_ACTIVITY = 0.2  # limit^2 per second: where a busier command begins to cost
_WIDTH = 0.08  # of the flight, the pulse's


class Case(NamedTuple):
    """What is not in the record: how far the inertia is open, and what is flown."""

    inertia: float  # believed, kg m^2
    limit: float  # of the command, in its unit
    spread: tuple[float, float]  # of the inertia, times the believed one
    told: float  # relative error of the inertia told to the controller
    step: float  # deg
    disturbance: float | None  # N m; a tenth of the limit's torque if None
    noise: float  # deg, of the measured angle
    sensitivity: float  # the limit of the peak of |S|
    duration: float  # s
    dt: float  # s, of the controller
    members: int
    fresh: int
    seed: int


def tuned_case(found: Fit, record: Record, case: Case) -> Tuned:
    """Tune a scheduled LADRC for the angle, beginning at certainty equivalence.

    Raises ValueError for an output that is not known to be in rad or rad/s, a negative gain and
    values that cannot be; NotIdentifiable where the plant is not determined.
    """
    _check(record, case)
    ensemble = _ensemble(found, record, case)
    plant = ensemble.plant
    assert isinstance(plant, DecoupledAxes)
    gain = float(plant.torque_gain[0])
    if gain <= 0:
        raise ValueError(
            f"the gain is negative (KT = {gain:.4g}): identify with the input's sign turned round"
        )
    start = LADRC(10.0, 30.0, gain / case.inertia, limit=case.limit, dt=case.dt)
    map_of = certainty_equivalence(gain, case.inertia, span=case.spread)
    others = peers(plant, dt=case.dt)
    return tune(
        ScheduledLADRC(start, map_of),
        ensemble,
        _flight(gain, case),
        objective=_objective(case),
        limits=(Limit("sensitivity_peak", at_most=case.sensitivity),),
        members=case.members,
        fresh=case.fresh,
        peers={name: one for name, one in others.items() if name.startswith("CE")},
        key=jax.random.key(case.seed),
    )


def _check(record: Record, case: Case) -> None:
    [unit] = record.output_units
    if unit not in ("rad", "rad/s"):
        raise ValueError(
            f"the unit of {record.output_names[0]} is {unit or 'not known'}: gains are for an "
            "angle in rad, so identify with the output in rad/s or rad (--unit NAME=rad/s)"
        )
    for name in ("inertia", "limit", "step", "duration", "dt", "sensitivity"):
        if not 0 < getattr(case, name) < np.inf:
            raise ValueError(f"{name} is {getattr(case, name):g}: give one above 0")
    if not 0 < case.spread[0] < case.spread[1] < np.inf:
        low, high = case.spread
        raise ValueError(f"the spread {low:g} .. {high:g} has to rise from above 0: 0.5 3")


def _ensemble(found: Fit, record: Record, case: Case) -> Ensemble:
    return Ensemble.from_fit(
        found,
        recorded_dt=record.dt,
        believed=case.inertia,
        inertia=LogUniform(*case.spread),
        told=Normal(case.told) if case.told else 1.0,
        noise=np.radians(case.noise),
        drive=Saturation(case.limit),
        dt=case.dt,
    )


def _objective(case: Case) -> Objective:
    """That of EQUATIONS.md, section 3, whose knee of 20 V^2/s belongs to a limit of 10 V."""
    penalties = (
        Penalty("activity_rate", knee=_ACTIVITY * case.limit**2, weight=2.0),
        Penalty("sensitivity_peak", knee=2.0, weight=3.0),
        Penalty("abscissa", knee=-0.5, weight=5.0),
    )
    events = _events(case)
    return Objective(penalties=penalties, events=events, load_start=events[1])


def _events(case: Case) -> tuple[float, float, float]:
    return 0.0, _PULSE * case.duration, _BACK * case.duration


def _flight(gain: float, case: Case) -> Scenario:
    _, pulse, back = _events(case)
    torque = 0.1 * gain * case.limit if case.disturbance is None else case.disturbance
    angle = np.radians(case.step)
    return scenario(
        duration=case.duration,
        dt=case.dt,
        axes=1,
        reference=Step(angle) + Step(-angle, at=back),
        disturbance=Pulse(torque, width=_WIDTH * case.duration, at=pulse),
    )


def write_tuning(
    out: Path,
    record: Record,
    frf: FrequencyResponse,
    found: Fit,
    tuned: Tuned,
    case: Case,
    log: Path,
    name: str,
) -> list[str]:
    """Write the folder; returns the names of the files."""
    origin = provenance(log, settings=case._asdict())
    write_json(out / "tuned.json", tuned_content(tuned, case) | {"provenance": origin.content()})
    write_c_header(out / f"{name}.h", tuned.controller, name=name, axes=1)
    figures = {"convergence.png": convergence_figure(tuned.history)}
    if tuned.certificate is not None:
        figures["certificate.png"] = certificate_figure(tuned.certificate)
    for file, figure in figures.items():
        figure.savefig(out / file, dpi=130)
    write_report(
        out / "report.html", fit=found, frf=frf, record=record, tuned=tuned, provenance=origin
    )
    return ["tuned.json", f"{name}.h", "report.html", *figures]


def tuned_content(tuned: Tuned, case: Case) -> dict[str, Any]:
    """For JSON."""
    names = ("values", "cost", "converged", "stabilised", "evaluations", "seconds", "remarks")
    content = {name: getattr(tuned, name) for name in names}
    judged = {} if tuned.certificate is None else {"certificate": tuned.certificate.content()}
    return {"holds": tuned.holds} | content | judged | {"case": case._asdict()}
