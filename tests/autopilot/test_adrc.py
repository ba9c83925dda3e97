"""Parameters of Betaflight's proposed ADRC from a log, judged by the firmware's law itself."""

import numpy as np
import pytest
from scipy.signal import lfilter

import jaxquad as jq
from jaxquad.autopilot import (
    ADRCTargets,
    BetaflightADRC,
    BetaflightPID,
    FilterChain,
    FlownBetaflight,
    propose_adrc,
    PT1,
)


LAG, CURVE = 0.025, 0.5
GYRO, FILTERS = FilterChain((PT1(500.0),), 8000.0), (PT1(350.0),)
FLOWN = FlownBetaflight(
    BetaflightPID(
        p=[45.0] * 3, i=[80.0] * 3, d=[30.0] * 3, gyro=GYRO, filters=FILTERS,
        dterm=(PT1(105.0), PT1(150.0)), dt=1 / 4000,
    )
)  # fmt: skip
HOVER = 0.3


@pytest.mark.parametrize("wrong", [{"sensitivity": 1.0}, {"resonance": 0.9}, {"noise": 0.0}])
def test_targets_that_cannot_be_are_refused(wrong):
    with pytest.raises(ValueError, match="above 1"):
        ADRCTargets(**wrong)


@pytest.fixture(scope="module")
def found():
    """Of sweeps at three throttles: K in deg/s^2 per pidsum is 80 times the curve's slope."""
    rng, dt, count = np.random.default_rng(2), 0.004, 2000
    local = np.tile(np.arange(count) * dt, 3)
    u = np.where(local < 7, 100 * np.sin(2 * np.pi * (local + 34 * local**2 / 14)), 0.0)
    throttle = np.repeat([0.25, 0.4, 0.6], count)
    pole = np.exp(-dt / LAG)  # of 1 / (s (LAG s + 1)) under held inputs
    b = [0.0, dt - LAG * (1 - pole), LAG * (1 - pole) - pole * dt]
    gain = 80 * (1 - CURVE + 2 * CURVE * throttle)
    y = np.asarray(lfilter(b, [1.0, -1.0 - pole, pole], gain * u))
    record = jq.Record(
        np.arange(local.size) * dt, np.stack([u, throttle], axis=1),
        y + 2 * rng.standard_normal(y.size), input_names=("sum", "throttle"),
        output_names="rate", output_units="deg/s", hold="dt",
    )  # fmt: skip
    return jq.identify.gain_over_throttle(record)


@pytest.fixture(scope="module")
def proposal(found):
    return propose_adrc(found, FLOWN, "roll", hover=HOVER, fresh=64)


def peaks(found, stage, throttle: float, scale: float) -> np.ndarray:
    """Ms of new plants at a throttle, with the firmware's law and a plant of its own making."""
    law = BetaflightADRC(
        wc=stage.wc, wo=stage.wo, b0=stage.b0, b0_scale=scale, gyro=GYRO, filters=FILTERS,
        dt=1 / 4000,
    ).linear()  # fmt: skip
    plants, step = found.draw(np.array([throttle]), 40, seed=99), 1 / 4000
    omega = np.geomspace(1.0, 6000.0, 400)
    z = np.exp(1j * omega * step)
    A, c = np.asarray(law.A), np.asarray(law.C)
    inner = np.linalg.solve(z[:, None, None] * np.eye(len(A)) - A, np.asarray(law.measurement_in))
    back = inner @ c + float(law.measurement_through)
    hold = np.sinc(omega * step / 2 / np.pi) * np.exp(-0.5j * omega * step)
    s = 1j * omega
    plant = plants.gain[0][:, None] * np.exp(-plants.delay[:, None] * s) * hold
    plant *= np.pi / 180 / (s * (plants.lag[:, None] * s + 1))
    return 1 / np.min(np.abs(1 - plant * back), axis=1)


@pytest.mark.slow
def test_the_whole_numbers_keep_ms_by_the_law_itself_at_every_throttle(found, proposal):
    assert proposal.kind == "proposed"
    stage, power = proposal.stage, {"FIXED": 0, "SQRT": 0.5, "LINEAR": 1, "QUADRATIC": 2}
    assert all(float(x).is_integer() for x in proposal.parameters.values())
    worst = [
        peaks(found, stage, x, np.clip((x / HOVER) ** power[proposal.law], 1, 3)).max()
        for x in proposal.throttle
    ]
    assert max(worst) < 1.8
    # Other draws, and a hold without the plant beyond half of the loop's rate.
    assert max(worst) == pytest.approx(stage.peak, rel=0.03)


@pytest.mark.slow
def test_parameters_and_law_are_what_is_printed_and_can_be_written(proposal, tmp_path):
    for name, value in proposal.parameters.items():
        assert f"set {name} = {value:g}" in str(proposal)
    assert f"set adrc_b0_law = {proposal.law}" in str(proposal)
    old = {name: jq.autopilot.find_parameter("betaflight", name).default
           for name in proposal.parameters}  # fmt: skip
    files = jq.autopilot.write_parameter_files(
        tmp_path, "betaflight", old, dict(proposal.parameters), version=(2026, 6)
    )
    text = files.stages[-1].read_text()
    changed = [n for n, value in proposal.parameters.items() if value != old[n]]
    assert changed and all(f"set {n} = {proposal.parameters[n]:g}" in text for n in changed)


@pytest.mark.slow
def test_what_no_parameters_keep_is_not_proposed(found):
    never = propose_adrc(
        found, FLOWN, "roll", hover=HOVER, targets=ADRCTargets(sensitivity=1.01), fresh=8, bins=2
    )
    assert never.kind == "not to be flown" and not never.parameters
    assert "above 1.01" in never.verdict
    with pytest.raises(ValueError, match="axis is"):
        propose_adrc(found, FLOWN, "rol", hover=HOVER)
