"""Noise identification against dense covariances written down from their definitions, against records of simulators
that share no code with it (tests/truth/noise.py), and on measured logs of which it is known what they are not."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binom

from gyromodel.campaign import Campaign
from gyromodel.files import read_campaign
from gyromodel.noise import IdentifiedNoise, deviation, identify_noise, usual_interval
from gyromodel.noise import _reduced as reduction
from gyromodel.noise._identify import KINDS
from gyromodel.noise._lines import find_lines
from gyromodel.noise._reduced import Mixture
from gyromodel.noise_analysis import analyse_noise
from gyromodel.numerics.markov_cells import MarkovCells, Rows, log_determinant_and_gram
from gyromodel.numerics.maximise import maximise
from gyromodel.numerics.rounding import quantum
from tests.truth import noise as truth

RARE = 1e-5
FEW = 1e-3  # the same where eight records must tell: with less, a coverage of one half would pass
ROWS, STEP, N = 800, 0.5, 0.02


@pytest.fixture
def fixed() -> np.random.Generator:
    """One draw, the same in each run, where one verdict on it is tested."""
    return np.random.default_rng(1)


def white(rng: np.random.Generator, rows: int = ROWS) -> np.ndarray:
    return truth.white(rows, STEP, N, rng)


def identified(rate: np.ndarray) -> IdentifiedNoise:
    return identify_noise(rate, np.arange(len(rate)) * STEP)


def quantised(rows: int, Q: float, rng: np.random.Generator) -> np.ndarray:
    """Increments of an angle that was rounded with errors of standard deviation Q, over the interval."""
    return np.diff(Q * rng.uniform(-np.sqrt(3), np.sqrt(3), rows + 1)) / STEP


def test_filter_equals_the_dense_covariance(rng: np.random.Generator):
    """White, differenced white, a random walk and two Markov processes; gaps, a restart, missing samples."""
    n, cells = 70, 3
    interval = rng.uniform(0.5, 2.0, n)
    time, restart = np.cumsum(interval), np.isin(np.arange(n), [0, 30])
    follows, present = rng.random(n) < 0.8, rng.random(n) < 0.8
    columns = rng.standard_normal((n, 3))
    noise = MarkovCells(
        rng.uniform(0.1, 1, cells),
        rng.uniform(0.1, 1, cells),
        np.vstack([np.zeros(cells), rng.uniform(0.1, 3, (2, cells))]),
        rng.uniform(0.1, 1, (3, cells)),
    )
    rows = Rows(*(jnp.asarray(x) for x in (interval, restart, follows, present)))
    log_determinant, gram = log_determinant_and_gram(noise, rows, columns)
    record = np.cumsum(restart)
    begun = np.array([time[np.flatnonzero(record == r)[0]] for r in record])
    same = record[:, None] == record
    for c in range(cells):
        dense = noise.white[c] * np.eye(n)
        rounding = np.zeros((n, 2 * n))  # errors at the ends of samples, then at starts that are nobody's end
        for i in range(n):
            rounding[i, i] = 1.0
            rounding[i, i - 1 if follows[i] and not restart[i] else n + i] = -1.0
        dense += noise.differenced[c] * rounding @ rounding.T
        for decay, variance in zip(noise.decay[:, c], noise.variance[:, c], strict=True):
            if decay == 0:
                dense += same * variance * np.minimum.outer(time - begun, time - begun)
            else:
                dense += same * variance * np.exp(-decay * np.abs(time[:, None] - time))
        dense = dense[np.ix_(present, present)]
        x = columns[present]
        assert float(log_determinant[c]) == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-10)
        assert np.asarray(gram[..., c]) == pytest.approx(x.T @ np.linalg.solve(dense, x), rel=1e-9, abs=1e-10)


def mixture() -> Mixture:
    one = [np.array([v]) for v in (0.3, 0.7, 0.2)]
    return Mixture(*one, np.array([[0.9], [0.999], [0.3]]), np.array([[1.0], [2.0], [0.5]]))


def dense(noise: Mixture, n: int) -> np.ndarray:
    i = np.arange(n)
    total = noise.white[0] * np.eye(n) + noise.walk[0] * (np.minimum.outer(i, i) + 1.0)
    for phi, variance in zip(noise.correlation[:, 0], noise.variance[:, 0], strict=True):
        total += variance * phi ** np.abs(i[:, None] - i)
    steps = np.eye(n, n + 1, 1) - np.eye(n, n + 1)
    return total + noise.differenced[0] * steps @ steps.T


@pytest.mark.parametrize("size", [2, 8])
def test_means_of_groups_are_noise_of_the_same_kinds(size: int):
    """Up to a constant, which the bias takes."""
    groups = 30
    average = np.kron(np.eye(groups), np.ones(size) / size)
    centre = np.eye(groups) - 1.0 / groups
    expected = centre @ average @ dense(mixture(), groups * size) @ average.T @ centre
    assert centre @ dense(mixture().averaged(size), groups) @ centre == pytest.approx(expected, abs=1e-6)


def test_covariance_within_a_group_is_that_of_the_noise():
    size = 8
    contrasts, lag = reduction._contrasts(size), np.abs(np.subtract.outer(np.arange(size), np.arange(size)))
    assert contrasts @ contrasts.T == pytest.approx(np.eye(size - 1), abs=1e-12)
    assert contrasts.sum(axis=1) == pytest.approx(0.0, abs=1e-12)
    own = contrasts @ mixture().covariance(size)[:, 0][lag] @ contrasts.T
    assert own == pytest.approx(contrasts @ dense(mixture(), size) @ contrasts.T, abs=1e-12)


def test_maximise_finds_maxima_inside_and_at_bounds():
    def hills(x: np.ndarray) -> np.ndarray:
        return -((x[:, 0] - 1.0) ** 2) - 50.0 * (x[:, 1] - x[:, 0]) ** 2 - x[:, 0] ** 4

    start, both = np.array([[3.0, -2.0], [0.5, 2.0]]), np.array([[True, True], [True, False]])
    x, value = maximise(hills, start, both, np.array([0.0, 0.0]), np.array([9.0, 9.0]))
    peak = np.roots([4.0, 0.0, 2.0, -2.0])
    peak = float(peak[np.abs(peak.imag) < 1e-9].real[0])
    assert x[0] == pytest.approx([peak, peak], abs=0.02)
    assert x[1, 1] == 2.0
    assert value == pytest.approx(hills(x))
    assert maximise(hills, start, both, np.array([0.9, 0.0]), np.array([9.0, 9.0]))[0][0, 0] == 0.9


@pytest.mark.long
def test_grouping_changes_neither_values_nor_intervals(monkeypatch: pytest.MonkeyPatch):
    """White noise, quantisation and a walk that leads beyond the groups, on rows that the filter can still take all."""
    rng = np.random.default_rng(3)
    rate = white(rng) + truth.random_walk(ROWS, STEP, 3e-3, rng) + quantised(ROWS, 5e-3, rng)
    exact = identified(rate)
    monkeypatch.setattr(reduction, "MOST_ROWS", ROWS // 2)
    grouped = identified(rate)
    assert not grouped.approximate
    for key in ("noise_white", "noise_quantisation", "noise_random_walk"):
        a, b = grouped.terms[key], exact.terms[key]
        if key != "noise_quantisation":
            assert a.verdict == b.verdict
        close = 0.2 * (b.high - b.low)
        assert [a.value, a.low, a.high] == pytest.approx([b.value, b.low, b.high], abs=close), key


@pytest.mark.parametrize(
    ("key", "size"), [("noise_quantisation", 0.02), ("noise_flicker", 0.02), ("noise_random_walk", 4e-3)]
)
def test_each_kind_is_found_beside_white_noise(key: str, size: float, fixed: np.random.Generator):
    """Sizes ten times what a record shows; three times the interval holds the truth."""
    make = {
        "noise_quantisation": lambda: quantised(ROWS, size, fixed),
        "noise_flicker": lambda: truth.flicker(ROWS, STEP, size, fixed),
        "noise_random_walk": lambda: truth.random_walk(ROWS, STEP, size, fixed),
    }[key]
    found = identified(white(fixed) + make())
    for name, true in ((key, size), ("noise_white", N)):
        term = found.terms[name]
        assert term.verdict != "not identifiable"
        low, high = term.value - 3.0 * (term.value - term.low), term.value + 3.0 * (term.high - term.value)
        assert low < true < high, (name, term)


@pytest.mark.law
@pytest.mark.long
def test_white_noise_alone_is_seldom_anything_else(rng: np.random.Generator):
    """Eight records: each other kind exceeds its threshold in 0.5 % of them, and four kinds are tried."""
    other, covered = 0, 0
    for _ in range(8):
        found = identified(white(rng))
        term = found.terms["noise_white"]
        assert term.verdict == "found"
        covered += term.low < N < term.high
        rest = [t for name, t in found.terms.items() if name != "noise_white"]
        other += any(t.verdict != "not identifiable" for t in rest)
        assert all(t.low == 0.0 for t in rest if t.verdict == "not identifiable")
    assert binom.sf(other - 1, 8, 0.03) > RARE
    assert binom.cdf(covered, 8, 0.93) > FEW


def test_quantisation_alone_is_not_read_as_white_noise(fixed: np.random.Generator):
    found = identified(quantised(ROWS, 1e-3, fixed))
    assert found.terms["noise_quantisation"].value == pytest.approx(1e-3, rel=0.1)
    assert found.terms["noise_white"].verdict == "not identifiable"
    # Reading the deviation at 1 s off would give N = √3 Q.
    assert found.terms["noise_white"].high < 0.05 * np.sqrt(3) * 1e-3


def test_lines_and_trend_are_taken_out_of_the_noise(fixed: np.random.Generator):
    time = np.arange(ROWS) * STEP
    rate = white(fixed) + 0.02 * np.cos(2 * np.pi * 0.3111 * time + 1.0) + 1e-3 * time
    found = identified(rate)
    assert [line.frequency for line in found.lines] == pytest.approx([0.3111], abs=5e-4)
    assert abs(found.lines[0].amplitude - 0.02) < 5.0 * found.lines[0].std
    ramp = found.terms["noise_rate_ramp"]
    assert ramp.verdict == "found"
    assert ramp.value == pytest.approx(1e-3, rel=0.1)
    assert found.terms["noise_white"].value == pytest.approx(N, rel=0.1)
    assert found.fits


def test_the_interval_of_rounded_times_is_their_mean_within_gaps():
    """64.06 samples a second, in tenths of a millisecond: most steps are 15.6 ms, 0.07 % too short."""
    time = np.round(np.arange(10_000) / 64.06, 4)
    time[5000:] += 100.0
    assert usual_interval(time) == pytest.approx(1 / 64.06, rel=1e-5)


@pytest.mark.law
@pytest.mark.parametrize("walk", [0.0, 0.02])
def test_noise_alone_seldom_shows_a_line(walk: float, rng: np.random.Generator):
    """One record in a thousand, in white noise and above a random walk; the shortest have a window for a spectrum."""
    time, found = np.arange(ROWS) * STEP, 0
    for _ in range(400):
        rate = white(rng) + walk * np.sqrt(STEP) * rng.standard_normal(ROWS).cumsum()
        found += bool(find_lines(rate, time, STEP))
    assert binom.sf(found - 1, 400, 1e-3) > RARE


@pytest.mark.law
@pytest.mark.long
def test_limits_of_lines_and_of_unseen_markov_noise_hold(rng: np.random.Generator):
    """A line, and a Markov process too small to be found: its bound holds, and is not far above it."""
    time, constant, q = np.arange(ROWS) * STEP, 10.0, 2.5e-3
    hits, bounds = np.zeros(3, int), []
    for _ in range(8):
        line = 0.02 * np.cos(2 * np.pi * 0.3111 * time + rng.uniform(0, 6))
        found = identified(white(rng) + truth.markov(ROWS, STEP, q, constant, rng) + line)
        first, term = found.lines[0], found.terms["noise_markov"]
        limits = dict(term.bounds)
        bounds.append(limits.get(constant, np.inf))
        off = abs(first.amplitude - 0.02) / first.std, abs(first.frequency - 0.3111) / first.frequency_std
        hits += [off[0] < 1.96, off[1] < 1.96, bounds[-1] > q]
    for held in hits:
        assert binom.cdf(held, 8, 0.93) > FEW
    assert np.median(bounds) < 3.0 * q


def test_gaps_and_missing_samples_do_not_matter(fixed: np.random.Generator):
    time = np.arange(ROWS) * STEP
    time[ROWS // 2 :] += 400.0
    rate = white(fixed)
    rate[fixed.random(ROWS) < 0.1] = np.nan
    found = identify_noise(rate, time)
    assert found.terms["noise_white"].low < N * 1.1
    assert found.terms["noise_white"].high > N * 0.9


@pytest.mark.long
def test_lines_keep_their_size_across_gaps(fixed: np.random.Generator):
    """Two parts so far apart that the phase is lost, and single samples missing, where it must be carried on."""
    time = np.arange(2400) * STEP
    line = 0.1 * np.cos(2 * np.pi * 0.3111 * time + 1.0)
    rate = truth.white(2400, STEP, N, fixed) + line
    apart = np.where(np.arange(2400) < 1200, time, time + 83_011.3)
    sparse = np.where(fixed.random(2400) < 0.01, np.nan, rate)
    for found in (identify_noise(rate, apart), identify_noise(sparse, time)):
        ((frequency, amplitude, std, frequency_std),) = found.lines
        assert abs(amplitude - 0.1) < 4.0 * std
        assert abs(frequency - 0.3111) < 4.0 * frequency_std
        assert found.terms["noise_white"].value == pytest.approx(N, rel=0.1)
    # N √(2/T), of the longer part and of the whole.
    assert identify_noise(rate, apart).lines[0].std == pytest.approx(N * np.sqrt(2 / 600), rel=0.1)
    assert found.lines[0].std == pytest.approx(N * np.sqrt(2 / 1200), rel=0.1)


@pytest.mark.parametrize(
    "pattern", [np.arange(1200) % 3 == 0, np.arange(1200) % 60 < 4, np.arange(1200) % 2 == 0], ids=str
)
def test_sparse_records_are_read_at_their_own_pace(pattern: np.ndarray, fixed: np.random.Generator):
    """Every second or third sample, or four a minute: noise of the same density, between sparser samples."""
    rate = np.where(pattern, truth.white(1200, STEP, N, fixed), np.nan)
    found = identified(rate)
    step = np.median(np.diff(np.flatnonzero(pattern))) * STEP
    assert found.terms["noise_white"].value == pytest.approx(N * np.sqrt(step / STEP), rel=0.2)


def test_a_deviation_that_happens_to_be_zero_leads_nowhere():
    """Whole counts whose halves have equal sums: the longest octave has one term, and that is zero."""
    rng = np.random.default_rng(0)
    rate = np.round(rng.standard_normal(512))
    rate[256:] = rng.permutation(rate[:256])
    assert deviation(rate, STEP).deviation[-1] == 0.0
    found = identified(rate).terms["noise_white"]
    assert found.value == pytest.approx(rate.std() * np.sqrt(STEP), rel=0.1)
    assert found.low < found.value < found.high < 2 * found.value


def test_what_no_kind_explains_is_said(fixed: np.random.Generator):
    """White noise through a moving average, whose spectrum has zeros."""
    found = identified(np.convolve(fixed.standard_normal(ROWS + 5), np.ones(6), "valid"))
    assert not found.fits
    assert min(ratio for _, _, ratio in found.misfits) < 0.5


@pytest.mark.parametrize("values", [np.zeros(100), np.arange(20.0)])
def test_records_without_noise_are_refused(values: np.ndarray):
    with pytest.raises(ValueError, match="show no noise"):
        identified(values)


def test_reports_are_in_units_of_the_field(fixed: np.random.Generator):
    """N of 0.02 deg/h/√Hz is 0.02/60 deg/√h; the same through counts with a scale factor, and without in counts."""
    time, rate = np.arange(ROWS) * STEP, white(fixed)
    units = {"time": "s", "output": "deg/h"}
    said = analyse_noise(Campaign({"time": time, "output": rate}, units, {"kind": "rate"})).to_dict()
    term = said["noise"]["noise_white"]
    assert term["unit"] == "deg/sqrt(h)"
    assert term["value"] == pytest.approx(N / 60.0, rel=0.2)
    assert said["deviations"]["allan"]["deviation"][0] == pytest.approx(N / np.sqrt(STEP), rel=0.2)
    counts = {"time": time, "output": rate * 5.0}
    raw = Campaign(counts, units | {"output": "count/s"}, {"kind": "rate"})
    plain = analyse_noise(raw).to_dict()
    assert plain["unit"] == "count/s"
    assert plain["noise"]["noise_white"]["unit"] == "count/s/sqrt(Hz)"
    assert plain["remarks"]
    scaled = analyse_noise(
        Campaign(raw.columns, raw.units, {"kind": "rate", "nominal_scale_factor": "18000 count/deg"})
    )
    assert scaled.to_dict()["noise"]["noise_white"]["value"] == pytest.approx(term["value"], rel=1e-3)


@pytest.mark.parametrize("axis", ["y", "z"])
def test_dithered_ring_laser_log_is_not_called_white(axis: str, measured_data):
    """Its deviation falls as 1/τ, with dither lines folded into the band: white noise must not be read off it."""
    log = read_campaign(measured_data("rlg_static/campaign.csv.gz")).axis(axis)
    analysis = analyse_noise(log.select(slice(0, 1200)))
    assert not analysis.noise.fits
    assert not {"found", "ambiguous"} & {analysis.noise.terms[key].verdict for key in KINDS}
    assert any("not of these kinds" in remark for remark in analysis.remarks)


@pytest.mark.parametrize("offset", [0.0, 0.37])
def test_the_step_of_an_output_is_found(rng: np.random.Generator, offset: float):
    """A grid of 0.013 with values rounded to four digits, as files have them; noise that no grid made has no step."""
    noise = 0.1 * rng.standard_normal(20_000)
    values = np.round(np.round(noise / 0.013) * 0.013 + offset, 4)
    values[::9] = np.nan
    assert quantum(values) == pytest.approx(0.013, rel=1e-3)
    assert quantum(noise) is quantum(np.round(noise, 9)) is quantum(np.ones(9)) is None
