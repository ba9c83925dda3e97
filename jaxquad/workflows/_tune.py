"""Tune a controller on an identified axis: from a result and settings to certified gains."""

import dataclasses
from pathlib import Path

import jax
import numpy as np

import jaxquad.tuning as tuning
from jaxquad._core import announce, plain_content, staged_files
from jaxquad.control import certainty_equivalence, LADRC, ScheduledLADRC
from jaxquad.ensembles import Ensemble, LogUniform, Normal, Posterior
from jaxquad.export import write_c_header
from jaxquad.identify import UndeterminedError
from jaxquad.loops import Loop
from jaxquad.report import provenance, write_json
from jaxquad.simulation import Pulse, Saturation, Scenario, scenario, Step
from jaxquad.tuning import Tuned

from ._identification import Identification
from ._identify import identify_fit
from ._log import open_again
from ._result_file import load_result, require_radians, StoredResult
from ._settings import TuneSettings


_PULSE, _BACK = 0.375, 0.625  # of the flight: when the torque comes, and the step back
_ACTIVITY = 0.2  # limit^2 per second: where a busier command begins to cost
_WIDTH = 0.08  # of the flight, the pulse's
_START = 10.0, 30.0  # rad/s, wc and wo


@dataclasses.dataclass(frozen=True)
class Tuning:
    """A tuned controller as `tune` returns it, with what it was tuned on; `str()` shows both."""

    identification: Identification  # of a stored result the fit alone
    settings: TuneSettings
    tuned: Tuned  # controller, gains and certificate
    loop: Loop
    ensemble: Ensemble
    flight: Scenario

    def content(self) -> dict[str, object]:
        """Gains, certificate and settings, for JSON."""
        tuned = self.tuned
        certificate = tuned.certificate
        content = {
            "holds": tuned.holds,
            "verdicts": [verdict._asdict() for verdict in tuned.verdicts],
            "values": tuned.values,
            "controller": tuning.describe_controller(tuned.controller) | {"dt": self.loop.dt},
            "cost": tuned.cost, "converged": tuned.converged,
            "bounds": [bound._asdict() for bound in tuned.bounds],
            "stabilised": tuned.stabilised, "evaluations": tuned.evaluations,
            "seconds": tuned.seconds, "remarks": tuned.remarks,
            "certificate": None if certificate is None else certificate.content(),
            "settings": self.settings.content(),
            "identified_with": self.identification.settings.content(),
        }  # fmt: skip
        return {key: plain_content(value) for key, value in content.items()}

    def write(self, folder: str | Path) -> list[Path]:
        """Write `tuned.json`, a C header, `report.html` and the figures; returns their paths."""
        announce("figures and report")
        folder, axis, tuned = Path(folder), self.identification, self.tuned
        name = self.settings.name
        settings = {k: v for k, v in self.settings.content().items() if v is not None}
        origin = provenance(*axis.paths, settings=settings)
        flights = tuning.worst_flights(tuned, self.loop, self.ensemble, self.flight)
        from jaxquad.plot import certificate_figure, convergence_figure, flight, headless
        from jaxquad.report import write_report  # here: with them comes matplotlib

        with staged_files(folder) as draft:
            write_json(draft / "tuned.json", self.content() | {"provenance": origin.content()})
            write_c_header(draft / f"{name}.h", tuned.controller, name=name, axes=1)
            write_report(
                draft / "report.html", fit=axis.fit, frf=axis.frf, record=axis.records[0],
                tuned=tuned, flights=flights, provenance=origin, formula=axis.formula,
            )  # fmt: skip
            with headless():
                figures = {"convergence.png": convergence_figure(tuned.history)}
                if tuned.certificate is not None:
                    figures["certificate.png"] = certificate_figure(tuned.certificate)
                figures["flight.png"] = flight(flights)
            for file, panels in figures.items():
                panels.figure.savefig(draft / file, dpi=130)
        files = ("tuned.json", f"{name}.h", "report.html", *figures)
        return [folder / file for file in files]

    def __str__(self) -> str:
        return str(self.tuned)


def tune(
    result: str | Path | StoredResult | Identification, settings: TuneSettings, *,
    log: str | Path | None = None, progress: bool | None = None,
) -> Tuning:  # fmt: skip
    """Tune and certify a controller for the angle of an identified axis, as `jaxquad tune` does.

    A scheduled LADRC is tuned on plants that are drawn from everything the record leaves
    uncertain, times the spread of the inertia. It starts from certainty equivalence: the gains for
    the nominal plant, scaled with the inertia. Each plant flies a step, a torque pulse and a step
    back.

    **Arguments:**

    - `result`: what `identify` returned, or the folder of a result, whose fit is made again.
    - `settings`: what the record does not tell: inertia, limits, noise.
    - `log`: where the log lies, if it was moved.
    - `progress`: as in `jq.tune`.

    **Returns:** a `Tuning`, whose certificate was made on plants that were not tuned on.

    **Raises:** ValueError for an output whose unit is neither rad nor rad/s, and for a negative
    gain; `UndeterminedError` (a ValueError) where the record does not determine the plant.
    """
    axis = result
    if not isinstance(axis, Identification):
        stored = axis if isinstance(axis, StoredResult) else load_result(axis)
        stored.require_radians()
        axis = identify_fit(open_again(stored, log=log))
    if axis.filters:
        raise ValueError(
            "the model is up to what the gyro's filters were given, and a loop is closed behind "
            "them: identify with keep_gyro_filters=True"
        )
    if not axis.fit.verdict.fitted:
        raise UndeterminedError(axis.fit.verdict.summary)
    record = axis.records[0]
    require_radians(record.output_names[0], record.output_units[0])
    dt = record.dt if settings.dt is None else settings.dt
    posterior = Posterior(
        axis.fit, recorded_dt=record.dt if record.hold is None else "as fitted",  # held commands
        believed=settings.inertia, band=axis.band, largest_command=axis.largest_command,
    )  # fmt: skip
    ensemble = Ensemble(
        posterior,
        inertia=LogUniform(*settings.spread),
        assumed_inertia=Normal(settings.inertia_error) if settings.inertia_error else 1.0,
        noise=np.radians(settings.noise),
    )
    plant = posterior.plant
    gain = float(np.asarray(plant.torque_gain)[0])
    if gain <= 0:
        raise ValueError(
            f"the gain is negative (KT = {gain:.4g}): identify with the sign of the input reversed "
            "(--input NAME=-CHANNEL)"
        )
    wo = _START[1] if settings.wo is None else settings.wo
    wc = min(_START[0], wo / 3)
    start = LADRC(wc, wo, gain / settings.inertia, limit=settings.limit, dt=dt)
    schedule = certainty_equivalence(gain, settings.inertia, span=settings.spread)
    loop = Loop(
        plant, ScheduledLADRC(start, schedule), drive=Saturation(settings.limit), dt=dt,
        delay=posterior.delay,
    )  # fmt: skip
    announce(f"tuning on {settings.members} plants, then certifying on {settings.fresh}")
    # A step, a torque pulse and a step back, and what they cost.
    pulse, back = _PULSE * settings.duration, _BACK * settings.duration
    angle, torque = np.radians(settings.step), settings.disturbance
    torque = 0.1 * gain * settings.limit if torque is None else torque
    flight = scenario(
        duration=settings.duration, dt=dt, axes=1, reference=Step(angle) + Step(-angle, at=back),
        disturbance=Pulse(torque, width=_WIDTH * settings.duration, at=pulse),
    )  # fmt: skip
    # That of docs/tuning.md, whose knee of 20 V^2/s belongs to a limit of 10 V.
    penalties = (
        tuning.Penalty("activity_rate", knee=_ACTIVITY * settings.limit**2, weight=2.0),
        tuning.Penalty("sensitivity_peak", knee=2.0, weight=3.0),
        tuning.Penalty("abscissa", knee=-0.5, weight=5.0),
    )
    objective = tuning.Objective(penalties=penalties, events=(0.0, pulse, back), load_start=pulse)
    tuned = tuning.tune(
        loop, ensemble, flight, objective=objective,
        limits=(tuning.Limit("sensitivity_peak", at_most=settings.sensitivity),),
        free=None if settings.wo is None else ["ladrc.wc", "map.values"],
        members=settings.members, fresh=settings.fresh,
        peers={tuning.KNOWN_INERTIA: tuning.peers(plant, dt=dt)[tuning.KNOWN_INERTIA]},
        key=jax.random.key(settings.seed), progress=progress,
    )  # fmt: skip
    return Tuning(axis, settings, tuned, loop, ensemble, flight)
