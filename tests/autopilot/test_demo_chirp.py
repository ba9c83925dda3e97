"""The simulated Betaflight chirp flight: its file, its law, and what is identified of it."""

import json

import numpy as np
import pytest
from html_pages import Page

from jaxquad.autopilot import AutopilotProposal, AxesProposal, CHIRP_TRUTH, write_chirp_log
from jaxquad.cli import main
from jaxquad.records import propose, read_settings
from jaxquad.records.formats import load_log
from jaxquad.workflows import autopilot, AutopilotSettings


pytestmark = pytest.mark.usefixtures("compiled_quickly")
P, I = 0.032029, 0.244381  # per unit of the CLI
FLYING = slice(2500, None)  # rows: behind the take-off, with the throttle at rest


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return write_chirp_log(tmp_path_factory.mktemp("chirp") / "demo.bfl")


@pytest.fixture(scope="module")
def columns(log):
    return load_log(log).tables[""].columns


def relative(residual, signal):
    return np.sqrt(np.mean(residual**2) / np.mean(signal**2))


@pytest.mark.slow
def test_the_file_is_read_without_a_remark(log, columns):
    loaded = load_log(log)
    table = loaded.tables[""]
    assert table.time is not None and table.time.size == 19_000 and not loaded.remarks
    np.testing.assert_allclose(np.diff(table.time), 1e-3, atol=1e-9)
    assert set(np.diff(columns["loopIteration"].astype(int))) == {4}
    np.testing.assert_array_equal(loaded.tables["slow"].columns["flightModeFlags"], [1, 65, 1])
    assert read_settings(log).version == (2026, 6, 0)


@pytest.mark.slow
def test_the_same_seed_writes_the_same_file_and_another_one_does_not(log, tmp_path):
    assert write_chirp_log(tmp_path / "again.bfl").read_bytes() == log.read_bytes()
    assert write_chirp_log(tmp_path / "other.bfl", seed=1).read_bytes() != log.read_bytes()


def test_the_chirp_of_its_debug_channels_is_the_reference_of_roll(log):
    setup = propose(log).setup
    assert setup.axis == "roll" and setup.reference == "debug[3]"
    [(start, stop)] = setup.spans
    assert start is not None and stop is not None
    assert stop - start == pytest.approx(15, abs=0.1)


def test_before_take_off_nothing_moves_and_in_flight_no_motor_is_at_its_limit(columns):
    ground = slice(0, 1500)
    assert np.ptp(columns["gyroADC[0]"][ground]) < 6  # noise of 1 deg/s behind the filters
    assert not columns["axisI[0]"][ground].any() and not columns["setpoint[3]"][ground].any()
    motors = np.stack([columns[f"motor[{k}]"][FLYING] for k in range(4)])
    assert motors.min() > 1055 and motors.max() < 2000


@pytest.mark.parametrize(("axis", "p"), [(0, 45), (1, 47)])
def test_the_p_term_is_the_laws_to_rounding(columns, axis, p):
    """Set-point and gyro of the same loop are rounded to 1 deg/s, the term to 1."""
    error = columns[f"setpoint[{axis}]"] - columns[f"gyroADC[{axis}]"]
    logged = columns[f"axisP[{axis}]"][FLYING]
    assert np.max(np.abs(P * p * error[FLYING] - logged)) <= P * p + 0.5 + 1e-6


def test_feed_forward_has_no_part_in_a_chirp(columns):
    assert np.ptp(columns["setpoint[0]"]) > 200
    assert not any(columns[f"axisF[{k}]"].any() for k in range(3))


def test_the_integral_is_that_of_the_relaxed_error(columns):
    """At the log's rate, a quarter of the loop's; it drifts by what rounding loses."""
    r, y, logged = (columns[f"{x}[0]"] * 1.0 for x in ("setpoint", "gyroADC", "axisI"))
    share = 2 * np.pi * 15e-3 / (1 + 2 * np.pi * 15e-3)
    slow, factor = 0.0, np.ones_like(r)
    for n, now in enumerate(r):
        slow += share * (now - slow)
        factor[n] = max(0.0, 1 - abs(now - slow) / 40)

    def missing(factor):
        grown = np.cumsum(I * 80 * 1e-3 * factor * (r - y))
        miss = (grown - logged)[3000:18_000].reshape(-1, 500)  # anew every half second
        return relative(miss - miss[:, :1], logged[3000:18_000])

    assert missing(factor) < 0.03 and missing(np.ones_like(r)) > 0.3


def test_the_unfiltered_gyro_is_ahead_by_the_filters_and_one_gyro_sample(columns):
    """Two pt1 at 500 and 340 Hz are late by .32 and .47 ms, the PID by .125 ms behind them."""
    raw, smooth = (columns[f"{x}[0]"][3000:14_000] for x in ("gyroUnfilt", "gyroADC"))
    cross = np.fft.rfft(smooth) / np.fft.rfft(raw)
    hz = np.fft.rfftfreq(raw.size, 1e-3)
    strong = (hz > 2) & (hz < 10)  # where the chirp is far above the noise
    late = -np.angle(cross[strong]) / (2 * np.pi * hz[strong])
    assert 1e3 * np.median(late) == pytest.approx(0.32 + 0.47 + 0.125, abs=0.1)


@pytest.mark.slow
def test_the_command_finds_the_true_plant_and_shows_where_to_look(tmp_path, capsys):
    code = main(["demo", "--autopilot", "--out", str(tmp_path), "--quiet"])
    printed = capsys.readouterr().out
    content = json.loads((tmp_path / "autopilot.json").read_text())
    plant = content["plant"]
    assert plant["gain"] == pytest.approx(CHIRP_TRUTH["gain"], rel=0.03)
    assert plant["lag"] == pytest.approx(CHIRP_TRUTH["lag"], rel=0.05)
    assert plant["delay"] == pytest.approx(CHIRP_TRUTH["delay"], abs=2e-4)
    assert (tmp_path / "autopilot.html").exists() and (tmp_path / "demo.bfl").exists()
    assert "gain 36, lag 0.025 s, delay 0.000625 s" in printed
    assert printed.split("Look at ")[1].splitlines()[0] == str(tmp_path / "autopilot.html")
    assert code == 0 and content["kind"] == "proposed"
    shown = Page((tmp_path / "autopilot.html").read_text(encoding="utf-8"))
    assert "PROPOSED" in shown.text("h1")  # the first page that a pilot sees is a success
    linked = {each["href"] for each in shown.of("a") if "download" in each}
    assert linked and all((tmp_path / name).exists() for name in linked)
    low, high = plant["intervals_95"]["gain"]
    assert low < 36 < high and (tmp_path / "proposal_100.txt").exists()


def test_a_measured_and_a_simulated_flight_are_not_asked_for_together(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["demo", "--autopilot", "--flight"])
    assert stop.value.code == 2 and "not allowed with" in capsys.readouterr().err


@pytest.mark.slow
def test_gains_tuned_again_are_those_of_a_run_with_these_limits(tmp_path):
    log = write_chirp_log(tmp_path / "demo.bfl")
    heard = []
    both = autopilot(log, listener=lambda axis, one: heard.append((axis, one)))
    assert isinstance(both, AxesProposal)
    assert heard == [*both.axes.items(), *both.unread.items()]
    again = both.retuned(sensitivity=1.5, noise=1.2).axes["roll"]
    alone = autopilot(log, AutopilotSettings(axis="roll", sensitivity=1.5, noise=1.2))
    assert isinstance(alone, AutopilotProposal)
    assert again.new == alone.new != both.axes["roll"].new
    assert again.stages == alone.stages and again.verdict == alone.verdict
    assert again.settings.content()["sensitivity"] == 1.5
    with pytest.raises(ValueError, match="`members` is no limit"):
        alone.retuned(members=64)
    with pytest.raises(ValueError, match="nothing to tune again"):
        both.axes["pitch"].retuned(sensitivity=1.5)
