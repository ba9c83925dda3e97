"""Betaflight's proposed ADRC as a header describes it."""

import numpy as np
import pytest
from adrc_flights import ADRC, HEADER

from jaxquad.autopilot import (
    adrc_parameters,
    b0_law,
    betaflight_adrc_loop,
    flies_adrc,
)
from jaxquad.identify import B0Schedule


VERSION = (2026, 6, 0)


def test_law_filters_and_parameters_are_those_of_the_header():
    values = HEADER | ADRC | {"adrc_td_hz": "40", "adrc_sigma_decay": "5"}
    flown = betaflight_adrc_loop(values, VERSION, throttle=0.45)
    law = flown.law
    assert [float(x[0]) for x in (law.wc, law.wo, law.b0)] == [60.0, 200.0, 6000.0]
    assert law.filters == flown.pid.law.filters and len(law.filters) == 2
    assert float(law.b0_scale) == pytest.approx(np.sqrt(0.45 / 0.3))
    assert (float(law.setpoint_lowpass_hz), float(law.forgetting)) == (40.0, 0.5)
    held = flown.parameters()
    assert all(held[name] == x for name, x in adrc_parameters(values).items())
    assert held["adrc_hover_throttle"] == 30.0 and held["adrc_gyro_lpf_hz"] == 150.0
    assert float(flown.at(0.2).b0_scale) == 1.0 and float(flown.at(0.2).dt) == law.dt


@pytest.mark.parametrize(
    ("number", "law", "scale"),
    [("0", "QUADRATIC", 2.25), ("1", "SQRT", 1.5**0.5), ("2", "LINEAR", 1.5), ("3", "FIXED", 1.0)],
)
def test_laws_are_counted_as_the_firmware_does(number, law, scale):
    values = HEADER | ADRC | {"adrc_b0_law": number}
    assert b0_law(values) == law
    schedule = betaflight_adrc_loop(values, VERSION).schedule
    assert float(schedule.scale(0.45)) == pytest.approx(scale)


def test_b0_is_scaled_up_alone_and_to_a_limit():
    schedule = B0Schedule("QUADRATIC", 0.3)
    np.testing.assert_allclose(
        schedule.scale(np.array([0.1, 0.3, 0.45, 0.9])), [1.0, 1.0, 2.25, 3.0]
    )


def test_a_build_without_a_choice_of_laws_has_the_square():
    values = {
        k: x for k, x in (HEADER | ADRC).items() if k not in ("adrc_b0_law", "adrc_b0_scale_max")
    }
    assert b0_law(values) is None
    assert float(betaflight_adrc_loop(values, VERSION).schedule.scale(0.9)) == 9.0


def test_headers_that_cannot_be_read_say_why():
    assert not flies_adrc(HEADER) and flies_adrc(ADRC)
    with pytest.raises(ValueError, match="the PID flew"):
        betaflight_adrc_loop(HEADER, VERSION)
    with pytest.raises(ValueError, match="adrc_b0_law is 7"):
        betaflight_adrc_loop(HEADER | ADRC | {"adrc_b0_law": "7"}, VERSION)
    with pytest.raises(ValueError, match="no line adrcWO"):
        betaflight_adrc_loop(HEADER | {k: x for k, x in ADRC.items() if k != "adrcWO"}, VERSION)
