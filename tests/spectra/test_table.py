"""Responses that were measured elsewhere: their errors are those of the same estimate here."""

import numpy as np
import pytest
from scipy.io import savemat
from scipy.signal import lfilter

import jaxquad as jq


from_table = jq.FrequencyResponse.from_table
MODEL = jq.LaggedIntegrator(80.0, 0.06, 0.03)
OMEGA = np.geomspace(0.5, 40.0, 40)
EXACT = np.asarray(MODEL.frequency_response(OMEGA))[:, 0, 0]


def noisy(error=0.02, seed=0):
    white = np.random.default_rng(seed).normal(size=(2, OMEGA.size))
    return EXACT * (1 + error * (white[0] + 1j * white[1]))


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["row", "pairs"])
def test_a_fit_to_a_table_finds_the_model_within_its_errors(shape):
    response = noisy()[:, None, None] if shape == "pairs" else noisy()
    frf = from_table(OMEGA, response, random_error=0.02, input_names=["M"], output_names=["q"])
    fit = jq.fit(jq.LaggedIntegrator(60.0, 0.04, 0.04), frf)
    assert fit.identifiable and not fit.remarks
    np.testing.assert_array_less(np.abs(fit.values - [80.0, 0.06, 0.03]), 3 * fit.standard_errors)
    assert 0.7 < np.sqrt(fit.chi_squared) < 1.3
    assert "M -> q" in str(frf) and jq.loops.margins(frf).standard_errors


def test_the_errors_of_a_coherence_are_those_of_as_many_windows():
    error = np.full(OMEGA.size, 0.05)
    frf = from_table(OMEGA, EXACT, random_error=error, averages=12)
    again = from_table(OMEGA, EXACT, coherence=np.asarray(frf.coherence), averages=12)
    np.testing.assert_allclose(again.random_error, frf.random_error, rtol=1e-12)
    np.testing.assert_allclose(frf.coherence, 1 / (1 + 24 * 0.05**2), rtol=1e-12)
    single = from_table(OMEGA, EXACT, coherence=0.9, averages=1)
    np.testing.assert_allclose(single.random_error, np.sqrt(0.1 / 1.8), rtol=1e-12)
    variance = np.diagonal(np.asarray(frf.relative_covariance()))
    np.testing.assert_allclose(np.real(variance), 2 * 0.05**2, rtol=1e-9)


def averaged(averages, seed, coherence=0.9):
    """H1 and coherence of independent windows: a Gaussian input, the model, Gaussian noise."""
    white = np.random.default_rng(seed).normal(size=(4, averages, OMEGA.size))
    x, noise = white[0] + 1j * white[1], white[2] + 1j * white[3]
    y = EXACT * (x + np.sqrt(1 / coherence - 1) * noise)
    sxx, syy = (np.mean(np.abs(z) ** 2, axis=0) for z in (x, y))
    sxy = np.mean(x.conj() * y, axis=0)
    return sxy / sxx, np.abs(sxy) ** 2 / (sxx * syy)


@pytest.mark.slow
def test_the_intervals_of_tables_with_coherence_hold_the_truth():
    truth, start, names = (
        [80.0, 0.06, 0.03],
        jq.LaggedIntegrator(60.0, 0.04, 0.04),
        ("gain", "lag", "delay"),
    )
    tables = [averaged(20, seed) for seed in range(200)]
    fits = [jq.fit(start, from_table(OMEGA, h, coherence=g, averages=20)) for h, g in tables]
    low, high = np.moveaxis(np.array([[fit.interval(x) for x in names] for fit in fits]), 2, 0)
    held = np.mean((low <= truth) & (truth <= high), axis=0)
    # 95 % of 200 within 3.3 standard deviations of a binomial share.
    assert np.all((held > 0.9) & (held < 0.999)), held
    scatter = np.std([fit.values for fit in fits], axis=0)
    # The usual width, and the mean: a tenth of these records look as if a resonance were in them.
    np.testing.assert_allclose(np.median(high - low, axis=0) / 3.92, scatter, rtol=0.15)
    assert np.all(np.mean(high - low, axis=0) / 3.92 < 1.3 * scatter)


def test_a_table_is_the_response_that_it_came_from():
    frf = from_table(OMEGA, noisy(), random_error=0.02)
    frf = from_table(
        OMEGA / (2 * np.pi), magnitude_db=frf.magnitude_db[:, 0, 0], frequency_unit="Hz",
        phase_deg=frf.phase_deg[:, 0, 0], random_error=np.asarray(frf.random_error), dt=0.01,
        hold=0.01,
    )  # fmt: skip
    np.testing.assert_allclose(frf.response[:, 0, 0], noisy(), rtol=1e-12)
    np.testing.assert_allclose(frf.omega, OMEGA, rtol=1e-15)
    assert (frf.dt, frf.hold) == (0.01, 0.01)


@pytest.fixture(scope="module")
def estimated():
    """A response that was estimated here, of a plant with a held input."""
    time = 0.01 * np.arange(6000)
    white = np.random.default_rng(3).normal(size=(2, time.size))
    out = lfilter([0.0, 0.02, 0.01], [1.0, -1.7, 0.72], white[0]) + 0.02 * white[1]
    record = jq.Record(time, white[0], out, hold=0.01, input_names="M", output_names="q")
    windows = jq.spectra.Welch(4.0, overlap=0.0)  # 15 of them
    return jq.frequency_response(record, np.geomspace(2.0, 60.0, 20), estimator=windows)


def assert_equal_fits(one, other):
    model = jq.TransferFunction([30.0], [1.0, 10.0, 30.0], delay=0.001)
    first, second = (
        jq.fit(model, frf, cost=jq.identify.CoherenceWeighted()) for frf in (one, other)
    )
    np.testing.assert_allclose(first.values, second.values, rtol=1e-8)


@pytest.mark.slow
def test_the_fit_of_a_table_is_that_of_the_response_it_came_from(estimated, without_type_checks):
    coherence = np.asarray(estimated.coherence)
    table = from_table(
        estimated.omega, np.asarray(estimated.response), coherence=coherence, averages=15,
        input_names=["M"], output_names=["q"], dt=0.01, hold=0.01,
    )  # fmt: skip
    assert_equal_fits(table, estimated)
    control = pytest.importorskip("control", reason="python-control is not installed")
    back = control.frd(
        np.moveaxis(np.asarray(estimated.response), 0, -1), np.asarray(estimated.omega), 0.01,
        inputs=["M"], outputs=["q"],
    )  # fmt: skip
    table = from_table(back, coherence=coherence, averages=15, hold=0.01)
    assert (table.input_names, table.output_names, table.dt) == (("M",), ("q",), 0.01)
    assert_equal_fits(table, estimated)


def test_data_of_python_control_are_a_table(without_type_checks):
    control = pytest.importorskip("control", reason="python-control is not installed")
    data = control.frd(noisy(), OMEGA)
    frf = from_table(data, random_error=0.02)
    np.testing.assert_array_equal(frf.response[:, 0, 0], noisy())
    np.testing.assert_array_equal(frf.omega, OMEGA)
    assert frf.dt == 0.0
    with pytest.raises(ValueError, match="FrequencyResponse.from_table"):
        jq.models.from_control(data)
    with pytest.raises(ValueError, match="FrequencyResponseData alone"):
        from_table(data, noisy(), random_error=0.02)
    with pytest.raises(ValueError, match="FrequencyResponseData alone"):
        from_table(data, random_error=0.02, frequency_unit="Hz")


def cell(texts):
    return np.array(texts, dtype=object).reshape(-1, 1)


def properties(**changes):
    """Those of an `idfrd` of two outputs and one input, as `get` of MATLAB names them."""
    response = np.stack([noisy(), 2 * noisy(seed=1)])[:, None]
    covariance = np.zeros((*response.shape, 2, 2))
    covariance[..., 0, 0] = covariance[..., 1, 1] = (0.02 * np.abs(response)) ** 2
    return {
        "ResponseData": response, "Frequency": OMEGA[:, None], "FrequencyUnit": "rad/TimeUnit",
        "TimeUnit": "seconds", "Ts": 0.01, "InterSample": "zoh", "CovarianceData": covariance,
        "IODelay": np.zeros((2, 1)), "InputName": cell(["M"]), "OutputName": cell(["p", "q"]),
    } | changes  # fmt: skip


def read_back(folder, options=(), **changes):
    savemat(folder / "g.mat", {"s": properties(**changes), "other": 3.0})
    return jq.FrequencyResponse.from_idfrd(folder / "g.mat", **dict(options))


def test_the_properties_of_an_idfrd_are_a_table(tmp_path):
    frf = read_back(tmp_path)
    np.testing.assert_array_equal(frf.response[:, 1, 0], 2 * noisy(seed=1))
    np.testing.assert_allclose(frf.random_error, 0.02, rtol=1e-12)
    assert (frf.input_names, frf.output_names) == (("M",), ("p", "q"))
    assert (frf.dt, frf.hold) == (0.01, 0.01)
    hertz = read_back(tmp_path, FrequencyUnit="Hz", OutputName=cell(["", ""]), Ts=0.0)
    np.testing.assert_allclose(hertz.omega, 2 * np.pi * OMEGA, rtol=1e-15)
    assert hertz.output_names == ("y0", "y1") and hertz.dt == 0
    other = read_back(tmp_path, {"coherence": 0.8, "averages": 10}, CovarianceData=[])
    np.testing.assert_allclose(other.random_error, np.sqrt(0.2 / 16), rtol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"CovarianceData": []}, "needs its errors"),
        ({"FrequencyUnit": "rpm"}, "chgFreqUnit"),
        ({"TimeUnit": "minutes"}, "chgTimeUnit"),
        ({"IODelay": 0.02}, "absorbDelay"),
        ({"OutputName": cell(["q"])}, "ResponseData has 80 responses, .* 1 x 1 x 40"),
        ({"CovarianceData": np.zeros((2, 2))}, "CovarianceData has 1 responses"),
    ],
)
def test_properties_that_do_not_tell_the_response_are_refused(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        read_back(tmp_path, **changes)


def test_a_file_without_a_response_is_refused(tmp_path):
    savemat(tmp_path / "z.mat", {"y": OMEGA})
    with pytest.raises(jq.records.ReadError, match=r"structs with ResponseData and Frequency"):
        jq.FrequencyResponse.from_idfrd(tmp_path / "z.mat")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, "needs its errors"),
        ({"coherence": 0.9, "random_error": 0.1}, "needs its errors"),
        ({"random_error": 0.1, "response": None}, "needs its response"),
        ({"random_error": 0.1, "phase_deg": OMEGA}, "needs its response"),
        ({"random_error": 0.1, "frequency_unit": "kHz"}, "frequency_unit is 'kHz'"),
        ({"coherence": 1.2, "averages": 4}, "coherence runs from 1.2 to 1.2"),
        ({"random_error": 0.0}, "random error is 0"),
        ({"random_error": [0.1, 0.2]}, "random_error has the shape"),
        ({"coherence": 0.9}, "number of windows"),
        ({"coherence": 0.9, "averages": 0.0}, "averages is 0"),
        ({"random_error": 0.1, "omega": OMEGA[::-1]}, "rising"),
        ({"random_error": 0.1, "omega": OMEGA[:-1]}, "omega has the shape"),
        ({"random_error": 0.1, "response": np.where(OMEGA > 3, np.nan, EXACT)}, "not finite at 3"),
        ({"random_error": 0.1, "input_names": ["a", "b"]}, "input_names has 2 names"),
    ],
)
def test_a_table_that_is_none_is_refused(changes, message, without_type_checks):
    with pytest.raises(ValueError, match=message):
        from_table(**{"omega": OMEGA, "response": EXACT} | changes)
