"""Conditioned composite responses of three inputs and six outputs beside scipy's, in one run.

    python -m pytest tests/benchmarks/test_composite_speed.py -o addopts=

120 s at 500 Hz, windows of 30, 20, 12, 8 and 5 s that overlap by half, 100 frequencies. The peer
stacks tapered segments, transforms them with `scipy.signal.ZoomFFT` (on a linear grid, since it has
no other), conditions by `numpy.linalg.solve` and combines by the published weights, without the
published cost's iterations. Ours are log-spaced, include that cost, all checks, coherence and the
random error with leakage told from noise; the covariance between frequencies is computed when a fit
asks for it. The second peer adds the random error: transforms behind the derivatives of the windows
too, and a projection by `numpy.linalg.qr`.
"""

import jax
import numpy as np
import pytest
from scipy.signal import ZoomFFT

import jaxquad as jq


jax.config.update("jax_enable_x64", True)

RATE, SECONDS, LENGTHS = 500.0, 120, (30.0, 20.0, 12.0, 8.0, 5.0)
SAMPLES = int(RATE * SECONDS)
OMEGA = np.geomspace(0.5, 100.0, 100)
LINEAR = np.linspace(0.5, 100.0, 100)


def flight() -> jq.Record:
    rng = np.random.default_rng(0)
    u = np.cumsum(rng.standard_normal((SAMPLES, 3)), axis=0) * 0.01
    mixed = np.hstack([u @ rng.standard_normal((3, 3)), np.roll(u, 5, axis=0)])
    y = mixed + 0.05 * rng.standard_normal((SAMPLES, 6))
    return jq.Record(np.arange(SAMPLES) / RATE, u, y)


RECORD = flight()
ESTIMATOR = jq.spectra.Composite(windows=LENGTHS, overlap=0.5)
COLUMNS = np.hstack([RECORD.inputs, RECORD.outputs])
BAND = (LINEAR[0] / (2 * np.pi), LINEAR[-1] / (2 * np.pi))
ZOOMS = {
    seconds: ZoomFFT(int(seconds * RATE), BAND, 100, fs=int(RATE), endpoint=True)
    for seconds in LENGTHS
}


def ours(omega=OMEGA):
    return jax.block_until_ready(jq.frequency_response(RECORD, omega, estimator=ESTIMATOR))


def taper(length, derivative=0):
    angle = 2 * np.pi * np.arange(length) / length
    return (0.5 - 0.5 * np.cos(angle), np.sin(angle), np.cos(angle))[derivative]


def transformed(seconds, derivative=0, channels=9):
    """In absolute phase: windows share noise."""
    length = int(seconds * RATE)
    columns = COLUMNS[:, :channels]
    views = np.lib.stride_tricks.sliding_window_view(columns, length, axis=0)[:: length // 2]
    centred = views - views.mean(axis=2, keepdims=True)
    starts = np.arange(len(views)) * (length // 2) / RATE
    turn = np.exp(-1j * starts[:, None, None] * LINEAR)
    return ZOOMS[seconds](centred * taper(length, derivative)) * turn


def conditioned(sums, seconds):
    rows = sums.transpose(2, 1, 0)
    spectra = np.conj(rows) @ rows.swapaxes(1, 2) / len(sums)
    scale = 2 / RATE / (0.375 * seconds * RATE)
    xx, xy = spectra[:, :3, :3] * scale, spectra[:, :3, 3:] * scale
    yy = np.real(np.diagonal(spectra, axis1=1, axis2=2))[:, 3:] * scale
    response = np.linalg.solve(xx, xy)
    power = 1 / np.real(np.diagonal(np.linalg.inv(xx), axis1=1, axis2=2))
    rest = yy - np.real(np.einsum("fio,fio->fo", np.conj(xy), response))
    own = np.abs(response) ** 2 * power[:, :, None]
    coherence = own / (own + rest[:, None, :])
    return response, power[:, :, None] * np.ones((1, 1, 6)), coherence


def combined(transforms):
    """Response, and the share of each length in it."""
    parts = map(conditioned, transforms, LENGTHS)
    response, power, coherence = (np.stack(part) for part in zip(*parts, strict=True))
    count = SECONDS / np.array(LENGTHS)[:, None, None, None]
    error = (1 - coherence) / (coherence * 2 * (count - 2))
    share = (error.min(axis=0) / error) ** 2 * power
    share = share / np.sum(share, axis=0)
    return np.sum(share * response, axis=0), share


def peer():
    return combined([transformed(seconds) for seconds in LENGTHS])[0]


def overlaps():
    """Scalar products of all windows, of unit energy each."""
    rows = []
    for length in (int(seconds * RATE) for seconds in LENGTHS):
        for start in range(0, SAMPLES - length + 1, length // 2):
            rows.append(np.pad(taper(length), (start, SAMPLES - length - start)))
    rows = np.stack(rows) * np.sqrt(1 / np.repeat(ENERGIES, COUNTS))[:, None]
    return rows @ rows.T


COUNTS = [int(2 * SECONDS / seconds) - 1 for seconds in LENGTHS]
ENERGIES = [0.375 * seconds * RATE for seconds in LENGTHS]
OVERLAP = overlaps()


ENOUGH = 12  # windows that can tell leakage of three inputs from noise


def noise_power(seconds, sums, overlap):
    """Mean square of what inputs and leakage leave of the outputs, frequencies by outputs."""
    x, rest = np.split(sums.transpose(2, 0, 1), [3], axis=2)
    columns, own = x, np.zeros_like(rest)
    if len(sums) >= ENOUGH:
        once = transformed(seconds, 1).transpose(2, 0, 1)
        twice = transformed(seconds, 2, 3).transpose(2, 0, 1)
        columns, own = np.concatenate([x, once[..., :3], twice], axis=2), once[..., 3:]
    basis = np.linalg.qr(columns)[0]
    adjoint = basis.conj().swapaxes(1, 2)
    rest, own = (each - basis @ (adjoint @ each) for each in (rest, own))
    own /= np.sqrt(np.sum(np.abs(own) ** 2, axis=1, keepdims=True)) + 1e-300
    rest -= own * np.sum(own.conj() * rest, axis=1, keepdims=True)
    left = len(sums) - np.sum(basis.conj() * (overlap @ basis), axis=(1, 2)).real
    taken = np.sum(own.conj() * (overlap @ own), axis=1).real
    return np.sum(np.abs(rest) ** 2, axis=1) / (left[:, None] - taken)


def peer_with_errors():
    """Response and its random error; the noise is not smoothed along frequency."""
    transforms = [transformed(seconds) for seconds in LENGTHS]
    response, share = combined(transforms)
    ends = np.cumsum([0, *COUNTS])
    places = list(map(slice, ends[:-1], ends[1:]))
    power, effects = [], []
    for seconds, sums, energy, own in zip(LENGTHS, transforms, ENERGIES, places, strict=True):
        power.append(noise_power(seconds, sums, OVERLAP[own, own]) / energy)
        x = sums[:, :3].transpose(2, 1, 0)
        gram = x.conj() @ x.swapaxes(1, 2)
        effects.append(np.linalg.solve(gram, x.conj()) * np.sqrt(energy))
    weight = np.mean(share, axis=2)
    noise = np.exp(np.sum(weight * np.log(power), axis=0))
    gain = np.zeros(response.shape)
    for mine, first, each in zip(share, effects, places, strict=True):
        for its, second, other in zip(share, effects, places, strict=True):
            both = np.sum((first @ OVERLAP[each, other]) * second.conj(), axis=2).real
            gain += (mine * its) * both[:, :, None]
    return response, np.sqrt(noise[:, None, :] * gain / 2) / np.abs(response)


def test_both_find_the_same_response():
    found = np.swapaxes(np.asarray(ours(LINEAR).response), 1, 2)
    apart = np.abs(found - peer()) / np.abs(peer())
    assert np.median(apart) < 0.02


def test_both_find_the_same_random_error():
    found = np.swapaxes(np.asarray(ours(LINEAR).random_error), 1, 2)
    ratio = found / peer_with_errors()[1]
    assert 0.95 < np.median(ratio) < 1.05


@pytest.mark.benchmark(group="composite, 3 x 6")
def test_jaxquad(benchmark):
    benchmark.pedantic(ours, rounds=60, warmup_rounds=5)


@pytest.mark.benchmark(group="composite, 3 x 6")
def test_zoom_fft(benchmark):
    benchmark.pedantic(peer, rounds=15, warmup_rounds=2)


@pytest.mark.benchmark(group="composite, 3 x 6")
def test_zoom_fft_with_errors(benchmark):
    benchmark.pedantic(peer_with_errors, rounds=9, warmup_rounds=2)
