"""No certificate is green on a design that is bad beyond its linear loop."""

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest
from certificates_by_hand import certificate, judged, MEMBERS
from tuning_case import ensemble, equivalent, EVENTS, flight, J0, KT

import jaxquad as jq
from jaxquad.simulation import Encoder, Saturation
from jaxquad.tuning import Attainable, certify


LOOP: dict[str, Any] = {"drive": Saturation(10.0), "dt": 0.002}
SOUND = equivalent(8.0, 25.0)


def certified(
    controller: Any = SOUND, *, loop=(), members=64, scenario=None, events=EVENTS, **laws
):
    options = LOOP | dict(loop)
    drawn = laws.pop("ensemble", None) or ensemble(**laws)
    return certify(
        jq.Loop(jq.DecoupledAxes([KT], [J0]), controller, **options), drawn,
        flight() if scenario is None else scenario, members=members, linear_members=0,
        events=events, key=jax.random.key(0),
    )  # fmt: skip


def by_hand(itae=1.0, *, start=None, unsupported=(), activity=10.0, **others):
    """A step of 4 deg for 2 s: doing nothing makes 8 deg s^2."""
    wide = lambda x: np.full((1, 1, MEMBERS), np.radians(x))
    bounds: dict[str, Any] = {
        "linear": wide(0.9), "linear_peak": wide(4.0), "drive": wide(0.1), "nothing": wide(8.0),
        "carried": wide(0.0), "settled": wide(0.4), "command": 10.0, "step": 0.0,
        "moved": np.radians(4.0), "varies": True,
    }  # fmt: skip
    bounds |= {n: wide(x) if n in ("drive", "carried", "linear") else x for n, x in others.items()}
    design = dataclasses.replace(judged(itae, activity=activity), by_part=wide(itae))
    one = certificate({"tuned": design})
    return dataclasses.replace(
        one, start=start, unsupported=unsupported, attainable=Attainable(**bounds)
    )


@pytest.mark.parametrize(
    "numbers, reason",
    [
        ({"itae": 1.79}, ""),
        ({"itae": 1.81}, "more than twice the error of their linear loops"),
        ({"itae": 1.81, "drive": 0.95}, ""),
        ({"itae": 0.39, "linear": 0.01}, ""),
        ({"itae": 4.1, "linear": 3.0}, "more than half the error of doing nothing"),
        ({"carried": 1.9}, ""),
        ({"carried": 2.1}, "carried off by the disturbance, up to 2.1 deg"),
        ({"step": np.radians(0.39)}, ""),
        ({"step": np.radians(4.0)}, "half a step of the encoder is 2 deg, beyond 5% of the"),
        ({"start": judged(activity=0.9), "activity": 10.0}, ""),
        ({"start": judged(activity=2.0), "activity": 21.0}, "activity is 10.5 times that"),
        ({"start": judged(activity=0.1), "activity": 22.8}, "activity is 228 times that"),
        ({"unsupported": (("wo lies beyond", "Hold wo"),)}, "wo lies beyond"),
    ],
)
def test_performance_is_judged_against_what_the_same_plants_allow(numbers, reason):
    verdict = by_hand(**numbers).performance
    assert reason in verdict.text and (verdict.holds is False) == bool(reason)


def test_few_members_and_a_single_plant_decide_nothing(monkeypatch):
    few = by_hand()
    assert few.performance.holds is None and not few.holds
    assert str(few).startswith("CERTIFICATE OPEN on 12 fresh members, not to be flown")
    assert "12 members are too few" in few.performance.text
    monkeypatch.setattr("jaxquad.tuning._verdict.FEWEST", MEMBERS)
    assert by_hand().holds
    same = by_hand(varies=False)
    assert not same.holds and "all members are the same plant" in same.performance.text


@pytest.mark.slow
def test_a_sound_design_holds_also_on_other_manoeuvres():
    assert certified().holds
    assert certified(loop={"drive": Saturation(5.0)}).holds
    assert certified(loop={"encoder": Encoder(8192)}).holds
    gust = jq.scenario(
        duration=10.0, dt=0.002, axes=1, reference=jq.Step(np.radians(4.0)),
        disturbance=jq.Pulse(1.0, width=0.02, at=2.5),
    )  # fmt: skip
    assert certified(scenario=gust, events=(0.0, 2.5)).holds
    still = dataclasses.replace(flight(), reference=0 * flight().reference)
    assert certified(scenario=still).holds


@pytest.mark.slow
@pytest.mark.parametrize("counts", [90, 180, 360])
def test_an_encoder_that_does_not_resolve_the_step_is_no_performance(counts):
    """Of 4, 2 and 1 deg on a step of 4 deg."""
    found = certified(loop={"encoder": Encoder(counts)})
    assert found.performance.holds is False
    assert f"{180 / counts:.3g} deg, beyond 5% of the manoeuvre of 4 deg" in found.performance.text


@pytest.mark.slow
@pytest.mark.parametrize("limit", [1.92, 3.82, 4.0])
def test_a_limit_below_what_the_pulse_needs_is_no_performance(limit):
    """0.2 N m need 4.27 V."""
    found = certified(loop={"drive": Saturation(limit)})
    assert found.performance.holds is False
    assert "are carried off by the disturbance" in found.performance.text
    assert found.attainable is not None and np.all(found.idle.of("itae") > 0)


@pytest.mark.slow
def test_stiction_that_holds_the_step_off_its_target_is_no_performance():
    near = jq.ensembles.LogUniform(0.8, 1.25)
    without_integral = jq.PID(20.0, 0.0, 6.0, dt=0.002, measurement_filter=100.0)
    assert certified(without_integral, coulomb=0.002, inertia=near).performance.holds
    for coulomb in (0.05, 0.1):
        found = certified(without_integral, coulomb=coulomb, inertia=near).performance
        assert found.holds is False and "more than half the error of doing nothing" in found.text
        found = certified(coulomb=coulomb).performance
        assert found.holds is False and "twice the error of their linear loops" in found.text


@pytest.mark.slow
def test_sixteen_members_without_spread_are_not_green():
    found = certified(ensemble=jq.Ensemble(lag=0.02), members=16)
    assert found.stability.holds and not found.holds
    assert "not decided, since all members are the same plant" in found.performance.text


@pytest.mark.slow
def test_the_drive_allows_no_less_than_the_time_optimal_step():
    """Bang-bang from rest to rest: 7/12 s^2/a behind no lag; the bound is 1/2 s^2/a."""
    plain = jq.Ensemble(inertia=jq.ensembles.LogUniform(0.5, 3.0))
    step = jq.scenario(duration=2.5, dt=0.002, axes=1, reference=jq.Step(np.radians(30.0)))
    found = certified(ensemble=plain, scenario=step, events=())
    assert found.attainable is not None
    facts, size = found.facts, np.radians(30.0)
    fastest = size**2 / (10.0 * facts["torque_gain"] / facts["inertia"])
    np.testing.assert_allclose(found.attainable.drive[0], 0.5 * fastest, rtol=0.05)
    np.testing.assert_allclose(found.attainable.nothing[0], 0.5 * size * 2.5**2, rtol=0.01)
    assert np.all(found.design.of("itae") > 7 / 12 * fastest[0])
