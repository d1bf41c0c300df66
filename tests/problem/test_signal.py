"""Noise from signal-to-noise ratios: the paper's equations, information of Gaussian data, a simulated correlator."""

import numpy as np
import pytest
from bad_input import write
from files.test_constraint_files import rows as inline

from optloc import InvalidProblem, assemble, measured
from optloc.base.units import SPEED_OF_LIGHT
from optloc.files import read
from optloc.problem import Signal
from optloc.problem.noise import dense

BAND, TIME = 1e6, 2e-3
PAIRS = (np.array([[1, 2, 3, 4]]), np.zeros((1, 4), dtype=int))


@pytest.mark.parametrize("snr", [0.05, 1.0, 30.0])
def test_equal_ratios_are_the_equations_of_the_paper(snr):
    m, w = 5, 2.0 * np.pi * BAND
    one = np.ones((m - 1, m - 1))
    signal = Signal(np.full(m, snr), BAND, TIME, reference=0, speed=3e8)
    information = TIME * w**3 * snr**2 / (3.0 * np.pi * (1.0 + m * snr)) * (m * np.eye(m - 1) - one)
    np.testing.assert_allclose(signal.covariance("tdoa", *PAIRS)[0], 9e16 * np.linalg.inv(information), rtol=1e-9)
    gains = TIME * w * snr**2 / (np.pi * (1.0 + m * snr) ** 2)
    gains = gains * (m * (1.0 + m * snr) * np.eye(m - 1) + (1.0 - m * snr) * one)
    np.testing.assert_allclose(signal.covariance("groa", *PAIRS)[0], np.linalg.inv(gains), rtol=1e-9)


def information(snr, w, duration, *, known):
    """Return that of delays, log amplitudes and, where it is unknown, the level, by the traces of Gaussian data."""
    m, frequencies = len(snr), (np.arange(400) + 0.5) * w / 400
    total = 0.0
    for f in frequencies:
        v = np.sqrt(snr).astype(complex)
        inverse = np.linalg.inv(np.eye(m) + np.outer(v, v.conj()))
        turn = [np.where(np.arange(m) == i, -1j * f * v[i], 0.0) for i in range(m)]
        grow = [np.where(np.arange(m) == i, v[i], 0.0) for i in range(m)]
        slopes = [np.outer(d, v.conj()) + np.outer(v, d.conj()) for d in (*turn, *grow)]
        slopes += [] if known else [np.outer(v, v.conj())]
        white = [inverse @ slope for slope in slopes]
        total = total + np.array([[np.trace(a @ b).real for b in white] for a in white])
    return duration / (2.0 * np.pi) * total * w / 400


@pytest.mark.parametrize("known", [True, False])
def test_covariances_are_the_information_of_gaussian_data(known):
    snr = np.array([3.0, 0.4, 7.0, 1.5, 0.9])
    full = information(snr, 2.0 * np.pi * BAND, TIME, known=known)
    signal = Signal(snr, BAND, TIME, reference=2 if known else None)
    a, b = np.array([[0, 1, 3, 4]]), np.full((1, 4), 2)
    difference = np.zeros((4, 5))
    difference[np.arange(4), a[0]], difference[np.arange(4), b[0]] = 1.0, -1.0
    units = np.sqrt(np.abs(np.diag(full)))
    scaled = full / units[:, None] / units
    assert np.abs(scaled[:5, 5:]).max() < 1e-12  # delays tell nothing of gains
    delays = np.linalg.pinv(full[:5, :5], rcond=1e-9, hermitian=True)
    wanted = SPEED_OF_LIGHT**2 * difference @ delays @ difference.T
    np.testing.assert_allclose(signal.covariance("tdoa", a, b)[0], wanted, rtol=1e-4)
    if known:
        kept = [5, 6, 8, 9]
        gains = np.linalg.inv(full[np.ix_(kept, kept)])
    else:
        gains = difference @ np.linalg.pinv(full[5:, 5:], rcond=1e-9, hermitian=True)[:5, :5] @ difference.T
    size = np.sqrt(snr[b[0]] / snr[a[0]])
    np.testing.assert_allclose(signal.covariance("groa", a, b)[0], size[:, None] * gains * size, rtol=1e-4)


SNR, PART = np.array([4.0, 2.0, 8.0, 3.0]), 200


def correlated(rng, trials):
    """Return errors of delays (s) and of gain ratios against station 0, by maximum likelihood of made records.

    A record is a real signal of one period, flat from zero to the band's edge, shifted by whole turns of its spectrum.
    The delays line the spectra up for the most power of their weighted sum; the gains are the first eigenvector of the
    records' covariance.
    """
    snr, count = SNR, int(BAND * TIME)
    w = 2.0 * np.pi * np.arange(1, count + 1) / TIME
    delay = np.array([0.0, 3e-7, -2e-7, 1e-7])

    def complex_normal(*shape):
        return np.sqrt(0.5) * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))

    source, noise = complex_normal(trials, 1, count), complex_normal(trials, len(snr), count)
    x = np.sqrt(snr)[:, None] * np.exp(-1j * delay[:, None] * w) * source + noise
    tau = np.tile(delay, (trials, 1))
    for _ in range(6):  # Newton's steps from the truth: the peak next to it
        y = np.sqrt(snr)[:, None] * np.exp(1j * tau[..., None] * w) * x
        pairs = np.einsum("tif,tjf->tijf", y, y.conj())
        slope = -2.0 * np.einsum("tijf,f->tij", pairs.imag, w).sum(2)
        bend = 2.0 * np.einsum("tijf,f->tij", pairs.real, w**2)
        diagonal = np.einsum("tij->ti", bend) - np.einsum("tii->ti", bend)
        off = bend * (1.0 - np.eye(len(snr)))
        hessian = off - diagonal[..., None] * np.eye(len(snr))
        tau[:, 1:] -= np.linalg.solve(hessian[:, 1:, 1:], slope[:, 1:, None])[..., 0]
    lined = np.exp(1j * tau[..., None] * w) * x
    sample = np.einsum("tif,tjf->tij", lined, lined.conj()).real / count
    first = np.linalg.eigh(sample)[1][..., -1]
    ratio = first[:, :1] / first[:, 1:]
    return tau[:, 1:] - delay[1:], ratio - np.sqrt(snr[0] / snr[1:])


def against_a_correlator(trials, seed, within):
    rng = np.random.default_rng(seed)
    parts = [correlated(rng, PART) for _ in range(trials // PART)]
    delays, gains = (np.concatenate(part) for part in zip(*parts, strict=True))
    signal = Signal(SNR, BAND, TIME)
    a, b = np.array([[1, 2, 3]]), np.zeros((1, 3), dtype=int)
    for kind, error in (("tdoa", SPEED_OF_LIGHT * delays), ("groa", gains)):
        stated = signal.covariance(kind, a, b)[0]
        found = error.T @ error / trials
        sigma = np.sqrt(np.diag(found) / np.diag(stated))
        assert np.abs(sigma - 1.0).max() < within, (kind, sigma)
        # with their correlation: whitened errors have unit covariance
        root = np.linalg.inv(np.linalg.cholesky(stated))
        assert np.abs(root @ found @ root.T - np.eye(3)).max() < 2.5 * within


def test_noise_is_that_of_a_simulated_correlator(seed):
    # a standard deviation from 200 draws is itself 5 % uncertain: four of that
    against_a_correlator(200, seed, 0.2)


@pytest.mark.full
def test_noise_is_that_of_a_simulated_correlator_within_ten_per_cent(seed):
    against_a_correlator(4000, seed, 0.1)


STATIONS = np.array([[0.0, 0.0], [9e3, 0.0], [4e3, 8e3], [1e3, 9e3]])


def test_rows_of_an_epoch_share_their_noise():
    signal = Signal(np.array([4.0, 2.0, 8.0, 3.0]), BAND, TIME)
    pairs = {"a": np.tile([1, 2, 3], 2), "b": 0, "epoch": np.repeat([0, 1], 3)}
    problem = assemble(STATIONS, measured("tdoa", **pairs, signal=signal), measured("groa", **pairs, signal=signal))
    matrix = dense(problem.noise, np.arange(12))
    arrivals = assemble(STATIONS, measured("tdoa", **pairs, arrival_sigma=signal.arrival_sigma))
    np.testing.assert_allclose(matrix[:6, :6], dense(arrivals.noise, np.arange(6)), rtol=1e-12)
    np.testing.assert_allclose(matrix[6:9, 6:9], signal.covariance("groa", np.array([[1, 2, 3]]), PAIRS[1][:, :3])[0])
    assert not matrix[:3, 3:].any()
    assert not matrix[6:9, 9:].any()
    # other stations than the reference
    other = signal.covariance("tdoa", np.array([[2]]), np.array([[1]]))
    v = signal.arrival_sigma**2
    assert other[0, 0, 0] == pytest.approx(v[1] + v[2])


BAD = {
    "one station": (lambda: Signal([1.0, np.nan], BAND, TIME), "two or more"),
    "decibels": (lambda: Signal([1.0, -3.0], BAND, TIME), "not positive"),
    "no band": (lambda: Signal([1.0, 1.0], 0.0, TIME), "bandwidth.*positive number"),
    "no time": (lambda: Signal([1.0, 1.0], BAND, np.inf), "duration.*positive number"),
    "no reference": (lambda: Signal([1.0, 1.0], BAND, TIME, 2), "no station 2"),
    "angles": (lambda: assemble(STATIONS, measured("azimuth", a=[0], signal=Signal(np.ones(4), BAND, TIME))),
               "neither a time difference nor a gain ratio"),
    "ranges": (lambda: assemble(STATIONS, measured("range", a=[1], signal=Signal(np.ones(4), BAND, TIME))),
               "neither a time difference nor a gain ratio"),
    "too few": (lambda: assemble(STATIONS, measured("tdoa", a=[1], b=0, signal=Signal(np.ones(3), BAND, TIME))),
                "3 signal-to-noise ratios for 4 stations"),
    "silent": (lambda: assemble(STATIONS, measured("tdoa", a=[1], b=0, signal=Signal([1, np.nan, 1, 1], BAND, TIME))),
               "without a signal"),
    "twice": (lambda: measured("tdoa", a=[1], b=0, sigma=1.0, signal=Signal(np.ones(4), BAND, TIME)), "given once"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_is_said(case):
    make, message = BAD[case]
    with pytest.raises(InvalidProblem, match=message):
        make()


HEAD = """format = 1
[stations]
rows = [ { name = "A", x = 0.0, y = 0.0 }, { name = "B", x = 9000.0, y = 0.0 }, { name = "C", x = 4000.0, y = 8000.0 },
  { name = "D", x = 1000.0, y = 9000.0 } ]
"""


def file(folder, noise, kind="tdoa"):
    table = [{"a": a, "b": "A", "z": 1.0, "epoch": k} for k in range(2) for a in "BCD"]
    return read(write(folder, f'{HEAD}[[measurements]]\nkind = "{kind}"\n{noise}{inline(table)}')).problem


@pytest.mark.parametrize("kind", ["tdoa", "groa"])
def test_files_state_the_signal(kind, tmp_path):
    snr = '{ A = "6 dB", B = 2.0, C = "9 dB", D = 3 }'
    found = file(tmp_path, f'snr = {snr}\nbandwidth = "1 MHz"\nduration = "2 ms"\n', kind)
    signal = Signal([10**0.6, 2.0, 10**0.9, 3.0], BAND, TIME)
    wanted = signal.covariance(kind, np.array([[1, 2, 3]]), PAIRS[1][:, :3])[0]
    np.testing.assert_allclose(dense(found.noise, np.arange(3, 6)), wanted)
    one = file(tmp_path, "snr = 2.0\nbandwidth = 1e6\nduration = 0.002\n", kind)
    even = Signal(np.full(4, 2.0), BAND, TIME).covariance(kind, np.array([[1, 2, 3]]), PAIRS[1][:, :3])[0]
    np.testing.assert_allclose(dense(one.noise, np.arange(3)), even)


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        ("snr = 2.0\nbandwidth = 1e6\n", "needs duration"),
        ("snr = 2.0\nbandwidth = 1e6\nduration = 1.0\nsigma = 3.0\n", "more than once.*or snr"),
        ('snr = "2 m"\nbandwidth = 1e6\nduration = 1.0\n', "unknown unit 'm'.*power"),
        ("snr = -2.0\nbandwidth = 1e6\nduration = 1.0\n", "key 'snr'.*not positive"),
        ("snr = { A = 1.0, E = 1.0 }\nbandwidth = 1e6\nduration = 1.0\n", "no station 'E'"),
        ("snr = { A = 1.0, B = 1.0 }\nbandwidth = 1e6\nduration = 1.0\n", "without a signal"),
        ('snr = 1.0\nbandwidth = "1 km"\nduration = 1.0\n', "unknown unit 'km'"),
        ('snr = 1.0\nbandwidth = 1e6\nduration = "0 s"\n', "key 'duration'.*positive"),
    ],
)
def test_files_say_what_is_wrong_with_a_signal(noise, message, tmp_path):
    with pytest.raises(InvalidProblem, match=f"(?s){message}"):
        file(tmp_path, noise)
