"""The report: numbers as a metrologist writes them, the verdict in a sentence, and a page that opens offline.

Expected numbers are written by hand from the rule "uncertainty to two digits, value to the same digit"; figures and
tables are checked for what they must contain, on made-up diagnoses of every verdict.
"""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gyromodel.campaign import Campaign
from gyromodel.declarations import declarations
from gyromodel.diagnosis._data import read as search_data
from gyromodel.diagnosis._result import Candidate, Cause, Confuser, Diagnosis, Driver, Gain, ParameterValue, Round
from gyromodel.estimate import Estimate
from gyromodel.estimate._calibration import ParameterRow
from gyromodel.report import history_figure, sentence, with_uncertainty, write_report
from gyromodel.report._figures import _column, _output, figures
from gyromodel.report._numbers import number, pair, percent, stated, unit_text
from gyromodel.report._page import context
from gyromodel.report._series import abscissae, bins, explained, thinned
from gyromodel.report._template import _markup
from gyromodel.report._words import PHRASES
from gyromodel.study._sensitivity import History, Sensitivity

Make = Callable[..., Diagnosis]


class Fitted(Estimate):
    """Stands in for a fitted model, with its table, its model's kind and its record only."""

    def __init__(
        self, rows: tuple[tuple[str, str, float, float, str], ...], domain: str = "gyro", record: Any = None
    ) -> None:
        object.__setattr__(self, "rows", tuple(ParameterRow(*row) for row in rows))
        object.__setattr__(self, "model", SimpleNamespace(domain=domain))
        object.__setattr__(self, "record", record)

    def table(self) -> tuple[ParameterRow, ...]:
        return self.rows  # type: ignore[attr-defined]


GIVEN = (("scale_factor", "value", 1000.012, 0.031, "count/deg"), ("bias", "value", 1.84, 0.22, "deg/h"))
SEARCHED = (
    "bias_temperature_rate", "bias_temperature", "bias_temperature_curve", "bias_drift", "bias_step", "bias_periodic",
    "bias_warmup", "scale_asymmetry", "scale_nonlinearity", "scale_temperature", "scale_sagnac_sine", "scale_spline",
    "outliers",
)  # fmt: skip
DETECTABLE = {
    "bias_temperature_rate": (4.1, "deg/h/(degC/s)"),
    "bias_temperature": (0.021, "deg/h/degC"),
    "bias_drift": (0.00034, "deg/h/h"),
    "bias_periodic": (0.8, "deg/h"),
    "scale_asymmetry": (2.3, "ppm"),
    "scale_temperature": (0.12, "ppm/degC"),
    "scale_spline": (2.4e-5, "deg/s"),
}
SHUPE = Cause(
    "bias_temperature_rate",
    (ParameterValue("coefficient", 0.09812, 0.00301, "deg/s/(degC/s)"),),
    statistic=212.4, p_value=1e-40, p_adjusted=2e-39, posterior=0.9996,
    confusers=(
        Confuser("bias_temperature", 0.02), Confuser("bias_warmup", 0.31), Confuser("bias_drift", 0.94),
    ),
)  # fmt: skip
PERIODIC = Cause(
    "bias_periodic",
    (
        ParameterValue("cosine", 0.61, 0.08, "deg/h"),
        ParameterValue("sine", -0.2213, 0.079, "deg/h"),
        ParameterValue("frequency", 0.000412, 2e-6, "Hz"),
    ),
    statistic=19.1, p_value=1e-9, p_adjusted=3e-7, posterior=0.98,
)  # fmt: skip


def rate_table(rng: np.random.Generator, points: int = 430) -> Campaign:
    """Half-sweeps of rate at temperature soaks with ramps between them."""
    levels = np.r_[-150:151:15, 150:-151:-15].astype(float)
    rate = np.resize(levels, points) + rng.normal(0.0, 0.01, points)
    soak = np.minimum(np.arange(points) * 5 // points, 4)
    time = np.cumsum(np.full(points, 18.0))
    temperature = 42.0 + 3.7 * np.interp(time, time[[0, -1]], [0.0, 4.2]) + 1.4 * np.sin(time / 700.0)
    output = 1000.0 * rate + rng.normal(0.0, 0.1, points)
    columns = {"time": time, "rate": rate, "temperature": temperature, "segment": soak.astype(float), "output": output}
    units = {"time": "s", "rate": "deg/s", "temperature": "degC", "segment": "", "output": "count/s"}
    return Campaign(columns, units, {"kind": "rate", "gyro": "fog", "test": "rate table"}, "fog_rate_temperature")


def static_log(rng: np.random.Generator, points: int = 18_000) -> Campaign:
    """Five hours at rest through a slow temperature cycle, with missing samples and a gap."""
    time = np.arange(points) * (18_000.0 / points)
    time[points // 2 :] += 1500.0
    temperature = 20.0 + 12.0 * np.sin(2.0 * np.pi * time / 14_000.0)
    coil = temperature - 2.0 * np.cos(2.0 * np.pi * time / 14_000.0)
    output = 0.0021 + rng.normal(0.0, 2e-4, points)
    output[rng.integers(0, points, points // 100)] = np.nan
    supply = 5.0 + rng.normal(0.0, 0.002, points)
    columns = {"time": time, "temperature": temperature, "temperature_coil": coil, "supply_voltage": supply}
    columns |= {"pressure": np.full(points, 1013.0), "output": output}
    units = {"time": "s", "temperature": "degC", "temperature_coil": "degC", "supply_voltage": "V", "pressure": "mbar"}
    return Campaign(columns, units | {"output": "deg/s"}, {"kind": "rate", "gyro": "fog"}, "static_night")


def slope(campaign: Campaign) -> np.ndarray:
    return np.gradient(campaign.columns["temperature"], campaign.columns["time"])


def made(campaign: Campaign, error: np.ndarray, noise: float, rng: np.random.Generator, **change: Any) -> Diagnosis:
    """A diagnosis of a hidden error that the extension explains up to noise."""
    hidden = error - error.mean()
    after = np.where(np.isfinite(campaign.columns["output"]), rng.normal(0.0, noise, len(campaign)), np.nan)
    before = after + hidden
    scale, unit = (1000.0, "count/s") if "rate" in campaign.columns else (1.0, "deg/s")
    simulated = 0.0021 * scale + scale * campaign.columns.get("rate", np.zeros(len(campaign)))
    campaign = campaign.with_column("output", simulated + scale * before, unit)
    spread = float(np.nanstd(before)), float(np.nanstd(after))
    gain = Gain(
        *spread,
        "deg/s",
        (ratio := spread[0] / spread[1]),
        (0.93 * ratio, 1.08 * ratio),
        "leave one segment out",
        5,
        180.2,
        (120.0, 240.5),
    )
    ranking = (
        Candidate("bias_temperature_rate", 212.4, 0.9996, "effect"),
        Candidate("smooth(temperature)", 101.3, 2e-9, "driver"),
        Candidate("noise_random_walk", 40.2, 1e-9, "noise"),
        *(Candidate(name, 9.0 - 2.0 * i, 1e-12, "effect") for i, name in enumerate(SEARCHED[1:])),
    )
    rest = (*(Candidate(n, -1.0 - i, 0.01, "effect") for i, n in enumerate(SEARCHED)),)
    fields: dict[str, Any] = {
        "verdict": "named", "causes": (SHUPE,), "driver": None, "gain": gain, "next_test": None,
        "minimum_detectable": DETECTABLE,
        "not_testable": {
            "bias_thermal_hysteresis": "needs two temperature ramp speeds", "bias_magnetic": "needs magnetic_field",
        },
        "noise": {
            "noise_white": {"value": 0.0123, "lo": 0.0119, "hi": 0.0127, "unit": "deg/sqrt(h)"},
            "noise_random_walk": {"value": 4e-4, "lo": 0.0, "hi": 1.1e-3, "unit": "deg/h/sqrt(h)"},
        },
        "noise_kinds": {"noise_white": 0.71, "noise_white + noise_random_walk": 0.27},
        "evidence": {"bias_temperature_rate": (203.1, 205.0, 204.2, 203.2), "bias_drift": (-1.0, -2.1, -3.2, -4.4)},
        "rounds": (
            Round(None, 0.0, ranking, spread[0], 0.0),
            Round("bias_temperature_rate", 212.4, rest, spread[1], 180.2),
        ),
        "credible_set": {"bias_temperature_rate": 0.9996},
        "unexplained": {"temperature": 0.004, "time": 0.021},
        "findings": ("noise grows with |rate|",),
        "threshold": 5.0, "threshold_kind": "safe", "p_value": None, "searched": SEARCHED, "campaign": campaign,
        "predicted_before": simulated, "predicted_after": simulated + scale * hidden,
        "residual_before": before, "residual_after": after, "rate_unit": "deg/s",
        "baseline": Fitted(GIVEN),
        "extended": Fitted((*GIVEN, ("bias_temperature_rate", "coefficient", 0.09812, 0.00301, "deg/s/(degC/s)"))),
    }  # fmt: skip
    return Diagnosis(**(fields | change))


def unchanged(diagnosis: Diagnosis) -> dict[str, Any]:
    """The fields of a diagnosis that extends nothing."""
    after, predicted = diagnosis.residual_after, diagnosis.predicted_after
    gain = replace(
        diagnosis.gain,
        before=1.1e-4,
        after=1.1e-4,
        ratio=1.0,
        ci95=(1.0, 1.0),
        log_score=0.0,
        log_score_ci95=(0.0, 0.0),
    )
    return {
        "causes": (), "gain": gain, "rounds": (replace(diagnosis.rounds[1], added=None),), "credible_set": {},
        "residual_before": after, "residual_after": after, "predicted_before": predicted, "predicted_after": predicted,
        "extended": diagnosis.baseline,
    }  # fmt: skip


def named(rng: np.random.Generator, points: int = 430) -> Diagnosis:
    campaign = rate_table(rng, points)
    return made(campaign, 0.0981 * slope(campaign), 1.1e-4, rng)


def named_static(rng: np.random.Generator, points: int = 18_000) -> Diagnosis:
    campaign = static_log(rng, points)
    return made(campaign, 0.0981 * slope(campaign), 2e-4, rng, causes=(SHUPE, PERIODIC))


def adequate(rng: np.random.Generator, points: int = 430) -> Diagnosis:
    base = made(rate_table(rng, points), np.zeros(points), 1.1e-4, rng)
    calibrated = {"threshold": 7.2, "threshold_kind": "calibrated", "p_value": 0.42}
    return replace(base, verdict="adequate", **calibrated, **unchanged(base))


def ambiguous(rng: np.random.Generator, points: int = 18_000) -> Diagnosis:
    campaign = static_log(rng, points)
    drift = Cause(
        "bias_drift",
        (ParameterValue("slope", 0.22, 0.05, "deg/h/h"),),
        9.1,
        1e-5,
        1e-4,
        0.52,
        (Confuser("noise_random_walk", 0.01),),
    )
    walk = Cause(
        "noise_random_walk", (ParameterValue("coefficient", 0.31, 0.12, "deg/h/sqrt(h)"),), 8.9, 1e-5, 1e-4, 0.44
    )
    error = 6e-5 * (campaign.columns["time"] / 9000.0 - 1.0)
    base = made(campaign, error, 2e-4, rng)
    ranking = (Candidate("bias_drift", 9.1, 0.52, "effect"), Candidate("noise_random_walk", 8.9, 0.44, "noise"))
    gain = replace(
        base.gain,
        before=2.04e-4,
        after=2.01e-4,
        ratio=1.015,
        ci95=(0.99, 1.04),
        log_score=6.0,
        log_score_ci95=(1.2, 11.0),
    )
    return replace(
        base, verdict="ambiguous", causes=(drift, walk), gain=gain,
        credible_set={"bias_drift": 0.52, "noise_random_walk": 0.44},
        rounds=(
            replace(base.rounds[0], ranking=ranking), replace(base.rounds[1], added="bias_drift", statistic=9.1),
        ),
        next_test="Repeat the run: a drift returns with the same slope, a random walk does not.",
    )  # fmt: skip


def unknown(rng: np.random.Generator, points: int = 430) -> Diagnosis:
    campaign = rate_table(rng, points)
    heat = campaign.columns["temperature"]
    x = np.linspace(heat.min(), heat.max(), 80)
    shape = lambda t: 5e-4 * np.sin(t / 1.7) * np.exp(-((t - 50.0) ** 2) / 40.0)  # noqa: E731
    near = {"nearest": "bias_temperature_curve", "nearest_share": 0.41, "behind": 23.4}
    driver = Driver("temperature", "degC", x, shape(x), np.full(80, 3e-5), "deg/s", **near)
    base = made(campaign, shape(heat), 1.1e-4, rng)
    step = replace(
        base.rounds[0],
        ranking=(Candidate("smooth(temperature)", 88.0, 0.999, "driver"), *base.rounds[0].ranking[3:]),
    )
    return replace(
        base, verdict="unknown", causes=(), driver=driver, credible_set={"smooth(temperature)": 0.999},
        rounds=(step,), next_test="Hold the temperature at 48 °C, then at 52 °C, for an hour each.",
    )  # fmt: skip


def outlying(rng: np.random.Generator, points: int = 430) -> Diagnosis:
    base = named(rng, points)
    rows = tuple(int(i) for i in np.flatnonzero(np.abs(base.campaign.columns["rate"] - 150.0) < 1.0)[:6])
    before, after = base.residual_before.copy(), base.residual_after.copy()
    before[list(rows)] += 2.2e-3
    after[list(rows)] += 2.2e-3
    cause = Cause("outliers", (), 61.0, 1e-20, 1e-18, 0.999, (), rows, "in data rows 6 to 7")
    return replace(base, causes=(SHUPE, cause), residual_before=before, residual_after=after)


VERDICTS: dict[str, Make] = {
    "named": named,
    "named_static": named_static,
    "adequate": adequate,
    "ambiguous": ambiguous,
    "unknown": unknown,
    "outlying": outlying,
}


@pytest.mark.parametrize(
    ("value", "std", "unit", "text"),
    [
        (0.098123, 0.00301, "deg/s/(degC/s)", "(0.0981 ± 0.0030) deg/s per °C/s"),
        (3.617e-4, 1.2e-5, "deg/s", "(3.62 ± 0.12)e-4 deg/s"),
        (1000.0123, 0.031, "count/deg", "(1000.012 ± 0.031) count/deg"),
        (12345.6, 678.0, "deg/h", "(1.235 ± 0.068)e4 deg/h"),
        (-0.2213, 0.079, "deg/h", "(-0.221 ± 0.079) deg/h"),
        (0.3, 1.24, "ppm", "(0.3 ± 1.2) ppm"),
        (0.0, 0.0996, "deg/h", "(0.00 ± 0.10) deg/h"),  # the uncertainty rounds up to one more digit
        (-0.004, 0.12, "", "0.00 ± 0.12"),  # no minus zero
        (9.996, 0.11, "V", "(10.00 ± 0.11) V"),
        (3e-9, 2e-5, "T", "(0.0 ± 2.0)e-5 T"),
        (12.0, 0.0, "degC", "12.0000 °C"),
        (1.234, math.nan, "deg/h", "1.23 deg/h (uncertainty unknown)"),
        (math.nan, 0.1, "deg/h", "not determined"),
    ],
)
def test_values_are_written_to_the_second_digit_of_their_uncertainty(value: float, std: float, unit: str, text: str):
    assert with_uncertainty(value, std, unit) == text


@given(st.floats(-1e9, 1e9, allow_nan=False, allow_subnormal=False), st.floats(-12, 6), st.floats(1.0, 9.99))
def test_what_is_written_is_within_half_a_digit(value: float, exponent: float, mantissa: float):
    std = mantissa * 10.0 ** math.floor(exponent)
    text = with_uncertainty(value, std)
    found = re.fullmatch(r"\(?(-?[\d.]+) ± ([\d.]+)\)?(?:e(-?\d+))?", text)
    assert found, text
    power = 10.0 ** int(found[3] or 0)
    digit = 10.0 ** (math.floor(math.log10(float(f"{std:.1e}"))) - 1)
    assert abs(float(found[1]) * power - value) <= 0.5001 * digit + 1e-12 * abs(value)
    assert abs(float(found[2]) * power - std) <= 0.5001 * digit
    assert len(found[2].lstrip("0.").replace(".", "")) == 2
    decimals = [part.partition(".")[2] for part in found.groups()[:2]]
    assert len(decimals[0]) == len(decimals[1])


@pytest.mark.parametrize(
    ("unit", "text"),
    [
        ("deg/h/degC", "deg/h per °C"),
        ("deg/s/(degC/s)", "deg/s per °C/s"),
        ("ppm/degC", "ppm per °C"),
        ("deg/sqrt(h)", "deg/√h"),
        ("deg/h/sqrt(h)", "deg/h/√h"),
        ("deg/h/h", "deg/h/h"),
        ("m/s^2", "m/s²"),
        ("deg/h/g", "deg/h per g"),
        ("deg/h/g^2", "deg/h per g²"),
        ("count/deg", "count/deg"),
        ("1/degC", "per °C"),
        ("degC*deg/s", "°C·deg/s"),
        ("", ""),
        ("[]", ""),
        ("1", ""),
    ],
)
def test_units_read_as_print(unit: str, text: str):
    assert unit_text(unit) == text


def test_numbers_to_compare_share_their_power_and_differ_where_they_can():
    assert pair(3.6e-4, 1.1e-4) == ("3.6e-4", "1.1e-4")
    assert pair(1.04e-3, 9.9e-4) == ("1.0e-3", "0.99e-3")
    assert pair(2.041e-4, 2.013e-4) == ("2.04e-4", "2.01e-4")
    assert number(0.0) == "0"
    assert number(-123.4) == "-123"
    assert number(2.4e-5) == "2.4e-5"
    assert percent(0.9996) == "> 99.9 %"
    assert percent(0.0) == "0 %"


def test_a_named_cause_is_said_with_its_size_and_the_gain():
    diagnosis = named(np.random.default_rng(1))
    gain = replace(diagnosis.gain, before=3.6e-4, after=1.1e-4, ratio=3.27, ci95=(2.6, 3.7))
    assert sentence(replace(diagnosis, gain=gain)) == (
        "Your simulation lacks a temperature-rate bias of (0.0981 ± 0.0030) deg/s per °C/s; with it the error on data "
        "not used falls from 3.6e-4 to 1.1e-4 deg/s."
    )


def test_a_gain_within_its_scatter_is_not_called_a_fall():
    diagnosis = named(np.random.default_rng(1))
    gain = replace(diagnosis.gain, ci95=(0.97, 1.2), log_score_ci95=(-1.0, 3.0))
    assert "within its own scatter" in sentence(replace(diagnosis, gain=gain))
    predicted = sentence(replace(diagnosis, gain=replace(gain, log_score_ci95=(1.0, 3.0))))
    assert "within its own scatter, but the spread of those data is clearly better predicted" in predicted
    assert "rises" in sentence(replace(diagnosis, gain=replace(gain, ci95=(0.8, 0.9))))
    assert "no two blocks can be left out" in sentence(replace(diagnosis, gain=replace(gain, after=math.nan)))


def test_each_verdict_has_its_sentence(rng: np.random.Generator):
    assert sentence(adequate(rng)).startswith("Nothing is missing that this campaign could show: 13 effects were")
    text = sentence(ambiguous(rng, 2000))
    assert "a bias drift in time or a rate random walk" in text
    assert text.endswith("Repeat the run: a drift returns with the same slope, a random walk does not.")
    assert "follows temperature and matches nothing in the catalogue" in sentence(unknown(rng))
    assert "cannot explain 6 measured points" in sentence(outlying(rng))
    both = sentence(named_static(rng, 2000))
    assert "temperature-rate bias of" in both
    assert "and a periodic bias with cosine (0.610 ± 0.080) deg/h, sine" in both


def test_an_ambiguity_keeps_what_is_sure_apart_from_the_set(rng: np.random.Generator):
    diagnosis = ambiguous(rng, 2000)
    text = sentence(replace(diagnosis, causes=(SHUPE, *diagnosis.causes)))
    assert text.startswith("Your simulation lacks a temperature-rate bias of (0.0981 ± 0.0030) deg/s per °C/s, and som")
    assert "a bias drift in time or a rate random walk" in text


def test_every_effect_of_the_catalogue_has_a_phrase():
    assert set(declarations()) - {"bias_column"} <= set(PHRASES)
    spare = set(PHRASES) - set(declarations())
    assert all(name.startswith(("noise_", "bias_acceleration_")) or name == "outliers" for name in spare)


def test_an_effect_outside_the_phrase_list_is_still_named(rng: np.random.Generator):
    diagnosis = named(rng)
    own = replace(SHUPE, effect="bias_laser_current")
    assert "a bias proportional to laser current of" in sentence(replace(diagnosis, causes=(own,)))


class Page(HTMLParser):
    """Collects what the tests ask of a page, and checks that tags are balanced."""

    VOID = ("meta", "br", "wbr", "link", "img", "path", "use")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.labels: list[str] = []
        self.addresses: list[str] = []
        self.headings: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = dict(attrs)
        self.ids += [named["id"] or ""] if "id" in named else []
        self.labels += [named["aria-label"] or ""] if named.get("role") == "img" else []
        self.addresses += [v or "" for k, v in attrs if k in ("src", "href", "xlink:href", "data")]
        self.headings += [tag] if re.fullmatch(r"h\d", tag) else []
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        if tag not in self.VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not {"style", "svg"} & set(self.open):
            self.text.append(data)


def read(path: Path) -> Page:
    page = Page()
    page.feed(path.read_text(encoding="utf-8"))
    assert not page.open
    return page


@pytest.mark.parametrize("name", VERDICTS)
def test_the_page_opens_offline_and_its_figures_have_words(name: str, rng: np.random.Generator, tmp_path: Path):
    diagnosis = VERDICTS[name](rng)
    report, *figures = write_report(diagnosis, tmp_path / "out")
    assert report == tmp_path / "out" / "report.html"
    page = read(report)
    text = re.sub(r"\s+", " ", "".join(page.text))
    assert all(address.startswith("#") for address in page.addresses)
    assert "url(http" not in report.read_text(encoding="utf-8")
    assert len(page.ids) == len(set(page.ids))
    assert page.headings.count("h1") == 1
    assert page.headings[0] == "h1"
    assert len(page.labels) == len(figures)
    assert all(re.search(r"\d", label) or "Measured output" in label for label in page.labels)
    assert report.stat().st_size < 1_500_000
    for wanted in ("Measured against simulated", "over each driver", "The gain", "What was searched"):
        assert wanted in text
    assert "gyromodel simulate model.yaml" in text
    assert "4.1 deg/h per °C/s" in text
    assert "needs two temperature ramp speeds" in text
    assert "nan" not in text.lower().replace("resonance", "")
    for figure in figures:
        root = ElementTree.parse(figure).getroot()
        assert root.get("viewBox")
        assert not list(root.iter("{http://www.w3.org/2000/svg}image"))
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["figures", "report.html"]
    assert sorted(figures) == sorted((tmp_path / "out" / "figures").iterdir())


def test_residuals_are_drawn_over_every_driver_and_the_cause_first(rng: np.random.Generator, tmp_path: Path):
    names = [path.stem for path in write_report(named(rng), tmp_path)[1:]]
    assert names[:3] == ["measured-simulated-rate", "measured-simulated-time", "residual-temperature-rate"]
    assert {"residual-time", "residual-temperature", "residual-rate", "residual-segment"} <= set(names)
    names = [path.stem for path in write_report(named_static(rng, 3000), tmp_path)[1:]]
    assert {"residual-phase", "residual-supply-voltage", "residual-temperature-coil"} <= set(names)
    assert "constant" in "".join(read(tmp_path / "report.html").text)


@pytest.mark.parametrize(("away", "label"), [(-5.2, "output + 5.2 deg/s"), (5.2, "output − 5.2 deg/s")])
def test_an_output_far_from_zero_is_drawn_less_an_offset_with_its_unit(away: float, label: str):
    """Beside a power of ten that is of the axis, and not of the offset."""
    rng = np.random.default_rng(1)
    before = static_log(rng, 400)
    output = before.columns["output"] - np.nanmedian(before.columns["output"]) + away
    found = made(before, slope(before), 1e-4, rng)
    far = np.full(400, away)
    diagnosis = replace(
        found, campaign=before.with_column("output", output, "deg/s"), predicted_before=far, predicted_after=far
    )
    assert f"{label} (10⁻⁵ deg/s)" in _output(diagnosis).svg


@pytest.mark.parametrize(
    ("text", "page"),
    [
        ("(3.6 ± 0.2)e-4 deg", "(3.6&nbsp;±&nbsp;0.2)&nbsp;×&nbsp;10<sup>−4</sup> deg"),
        ("-2.50e7, 3e-5", "−2.50&nbsp;×&nbsp;10<sup>7</sup>, 3&nbsp;×&nbsp;10<sup>−5</sup>"),
        ("smooth(T2e3), T_2e3, T1.5e3", "smooth(T2e3), T_2e3, T1.5e3"),
    ],
)
def test_powers_of_ten_are_of_numbers_and_not_of_names(text: str, page: str):
    assert str(_markup(text)) == page


def test_drawings_of_others_are_left_alone(rng: np.random.Generator, tmp_path: Path):
    (tmp_path / "figures").mkdir()
    for name in ("mine.svg", "residual-old.svg"):
        (tmp_path / "figures" / name).write_text("<svg/>")
    write_report(named(rng), tmp_path)
    assert (tmp_path / "figures" / "mine.svg").read_text() == "<svg/>"
    assert not (tmp_path / "figures" / "residual-old.svg").exists()


def test_thermometers_in_other_units_differ_by_temperatures(rng: np.random.Generator):
    diagnosis = named_static(rng, 3000)
    true = rng.normal(0.0, 1.0, 3000)
    warmer = diagnosis.campaign.columns["temperature"] - true
    campaign = diagnosis.campaign.with_column("temperature_coil", 32 + 1.8 * warmer, "degF")
    found, _ = abscissae(replace(diagnosis, campaign=campaign, residual_before=true))
    [difference] = [x for x in found if x.key == "temperature:difference:temperature_coil"]
    assert difference.unit == "degC"
    assert difference.values == pytest.approx(true)


def test_an_unknown_shows_the_function_it_follows(rng: np.random.Generator, tmp_path: Path):
    assert "driver" in [path.stem for path in write_report(unknown(rng), tmp_path)]
    diagnosis = unknown(rng)
    assert diagnosis.driver is not None
    computed = replace(diagnosis.driver, column="d(temperature)/dt", unit="degC/s", x=np.linspace(-0.01, 0.01, 80))
    write_report(replace(diagnosis, driver=computed), tmp_path)
    text = "".join(read(tmp_path / "report.html").text)
    assert "follows temperature rate" in text
    assert "a bias that curves with temperature comes closest: alone it explains 41 % of what" in text
    assert "Most probably white rate noise" in text
    write_report(replace(diagnosis, driver=replace(computed, column="temperature[earlier]", unit="degC")), tmp_path)
    assert "follows temperature some time before" in "".join(read(tmp_path / "report.html").text)


def test_every_ranking_is_of_what_could_be_added_next(rng: np.random.Generator):
    first, second = context(named(rng))["rankings"]
    assert first["title"] == "Round 1: ranked beside your simulation"
    assert [row["id"] for row in first["rows"] if row["chosen"]] == ["bias_temperature_rate"]
    assert second["title"] == "Round 2: ranked with a temperature-rate bias added"
    assert second["rows"][0]["statistic"] == "-1.0"
    assert not any(row["chosen"] for row in second["rows"])


def test_noise_kinds_and_the_fitted_terms_do_not_contradict_one_another(rng: np.random.Generator):
    """Markov noise is the fit's where it is likeliest, and a kind's name only where that outweighs its rarity."""
    kinds = {"noise_white + noise_flicker": 0.67, "noise_white + noise_markov": 0.29}
    white, markov = ({"value": 0.01, "lo": 0.01, "hi": 0.02, "unit": "deg/sqrt(h)"} for _ in range(2))
    diagnosis = replace(named(rng), noise_kinds=kinds, noise={"noise_white": white, "noise_markov": markov})
    assert context(diagnosis)["noise_kinds"].endswith("(29 %).")
    flicker = replace(diagnosis, noise_kinds={"noise_white + noise_flicker": 0.96, "noise_white + noise_markov": 0.04})
    assert "in which Markov noise was likeliest" in context(flicker)["noise_kinds"]
    other = replace(diagnosis, noise_kinds={"noise_white + noise_markov": 0.98}, noise={"noise_white": white})
    assert "the fit, which holds no Markov noise" in context(other)["noise_kinds"]


def test_stated_noise_has_no_interval(rng: np.random.Generator):
    noise = {"noise_white": {"value": 0.01, "lo": 0.01, "hi": 0.01, "unit": "deg/sqrt(h)"}}
    assert [row["interval"] for row in context(replace(named(rng), noise=noise))["noise"]] == ["stated"]


def test_what_was_set_aside_is_not_said_to_be_no_extension(rng: np.random.Generator, tmp_path: Path):
    base = outlying(rng)
    gain = replace(base.gain, after=base.gain.before)
    steps = (base.rounds[0], replace(base.rounds[1], added="outliers"))
    text = "".join(read(write_report(replace(base, causes=base.causes[1:], gain=gain, rounds=steps), tmp_path)[0]).text)
    assert "How the simulation was extended" in text
    assert "Nothing was added that predicts data not used" in text
    assert "was not extended" not in text


def test_points_that_stand_apart_are_ringed_with_their_rate(rng: np.random.Generator, tmp_path: Path):
    diagnosis = outlying(rng)
    report = write_report(diagnosis, tmp_path)[0]
    svg = (tmp_path / "figures" / "residual-rate.svg").read_text(encoding="utf-8")
    assert "150 deg/s" in svg
    assert "stands in data rows 6 to 7 (row 1 is the first below the header)" in "".join(read(report).text)


def test_foreign_names_cannot_break_the_page(rng: np.random.Generator, tmp_path: Path):
    diagnosis = named(rng)
    campaign = diagnosis.campaign.with_column("y<b>$x^2$ & z", np.arange(430.0), "")
    campaign = replace(campaign, name='"><script>alert(1)</script>')
    write_report(replace(diagnosis, campaign=campaign, next_test="</p><script>"), tmp_path)
    source = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<script" not in source
    assert "$x^2$" in source
    read(tmp_path / "report.html")


def test_a_report_without_models_gain_or_rounds_is_written(rng: np.random.Generator, tmp_path: Path):
    diagnosis = named(rng)
    nothing = math.nan
    gain = Gain(nothing, nothing, "deg/s", nothing, (nothing, nothing), "none", 0, nothing, (nothing, nothing))
    changes: dict[str, Any] = {"extended": Fitted(()), "rounds": (), "searched": (), "gain": gain}
    changes |= {
        "noise": {},
        "minimum_detectable": {},
        "not_testable": {},
        "credible_set": {},
        "unexplained": {},
        "findings": (),
    }
    text = "".join(read(write_report(replace(diagnosis, **changes), tmp_path)[0]).text)
    assert "No two blocks of the campaign can be left out" in text


def test_a_second_report_replaces_the_first_and_is_the_same(rng: np.random.Generator, tmp_path: Path):
    diagnosis = named(rng)
    first = [path.read_bytes() for path in write_report(diagnosis, tmp_path)]
    second = [path.read_bytes() for path in write_report(diagnosis, tmp_path)]
    assert first == second


def test_a_failed_write_leaves_the_old_report(
    rng: np.random.Generator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    diagnosis = named(rng)
    report = write_report(diagnosis, tmp_path)[0]
    before = report.read_bytes()

    def fail(*_: Any) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_report(replace(diagnosis, next_test="other"), tmp_path)
    assert report.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["figures", "report.html"]


def test_long_campaigns_stay_small(rng: np.random.Generator, tmp_path: Path):
    report = write_report(named_static(rng, 200_000), tmp_path)[0]
    assert report.stat().st_size < 1_500_000
    assert "of 396" in "".join(read(report).text)  # some of the 2 × 198 000 samples that are not missing


def test_writing_sets_no_global_state(rng: np.random.Generator, tmp_path: Path):
    import matplotlib

    before = dict(matplotlib.rcParams)
    write_report(adequate(rng), tmp_path)
    assert dict(matplotlib.rcParams) == before


def test_means_and_their_errors_agree_with_plain_numpy(rng: np.random.Generator):
    x = rng.permutation(np.repeat([-2.0, 0.0, 5.0], 50))
    y = rng.normal(size=150)
    y[3] = np.nan
    found = bins(x, y)
    for level, mean, error in zip(found.x, found.mean, found.error, strict=True):
        own = y[(x == level) & np.isfinite(y)]
        assert mean == pytest.approx(own.mean())
        assert error == pytest.approx(own.std(ddof=1) / math.sqrt(own.size))


def test_the_explained_share_is_corrected_for_the_number_of_bins(rng: np.random.Generator):
    x = rng.uniform(size=4000)
    noise = rng.normal(size=4000)
    assert explained(x, noise) < 0.02
    assert explained(x, 3.0 * x * math.sqrt(12.0) + noise) == pytest.approx(0.9, abs=0.02)


def test_thinning_does_not_alias_with_a_repeated_sequence():
    rate = np.resize(np.arange(12.0), 12_000)
    rows = thinned(rate, np.ones(12_000), 1000)
    assert rows.size == 1000
    assert np.all(np.bincount(rate[rows].astype(int)) > 70)


def test_a_sentence_needs_neither_drawing_nor_models():
    code = "import gyromodel.report, sys; print({'jax', 'matplotlib', 'jinja2', 'numpy'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "set()\n"


def words(report: Path) -> str:
    """The text of a page, in one line."""
    return re.sub(r"\s+", " ", "".join(read(report).text))


def panels(diagnosis: Diagnosis) -> list[tuple[str, bool]]:
    """The residual panels in order, and whether each is marked as what the error follows."""
    return [(panel.name, panel.cause) for panel in figures(diagnosis).residuals]


@pytest.mark.long
def test_a_pair_of_columns_is_a_driver_too(rng: np.random.Generator, tmp_path: Path):
    diagnosis = unknown(rng)
    assert diagnosis.driver is not None
    pair_of = replace(diagnosis.driver, column="rate and temperature", unit="deg/s", x=np.linspace(-150.0, 150.0, 80))
    diagnosis = replace(diagnosis, driver=pair_of, unexplained={"rate and d(rate)/dt": 0.3})
    assert "follows rate and temperature and matches nothing" in sentence(diagnosis)
    assert panels(diagnosis)[:2] == [("residual-temperature", True), ("residual-rate", True)]
    [drawn] = figures(diagnosis).driver
    assert "depends on more than rate," in drawn.caption
    assert drawn.caption.endswith("bars: two standard errors.")
    warm = replace(pair_of, second=np.repeat([-20.0, 0.0, 20.0, 40.0], 20), second_unit="degC")
    [drawn] = figures(replace(diagnosis, driver=warm)).driver
    assert "in parts by temperature" in drawn.caption
    assert re.findall(r">(\S+ °C)<", drawn.svg) == ["−20.0 °C", "0 °C", "20.0 °C", "40.0 °C"]
    assert "Rate and angular acceleration" in words(write_report(diagnosis, tmp_path)[0])
    turning = replace(diagnosis, driver=replace(pair_of, column="rate and d(rate)/dt"))
    assert "follows rate and angular acceleration and matches" in sentence(turning)
    assert {name for name, followed in panels(turning) if followed} == {"residual-rate", "residual-rate-rate"}


@pytest.mark.long
def test_a_column_whose_name_has_an_and_in_it_is_no_pair(rng: np.random.Generator):
    diagnosis = unknown(rng)
    assert diagnosis.driver is not None
    campaign = diagnosis.campaign.with_column("heat and cold", diagnosis.campaign.columns["temperature"], "degC")
    alone = replace(diagnosis, campaign=campaign, driver=replace(diagnosis.driver, column="heat and cold"))
    assert panels(alone)[0] == ("residual-heat-and-cold", True)
    [drawn] = figures(alone).driver
    assert drawn.caption.startswith("Line")
    assert "Squares" in drawn.caption
    both = replace(alone, driver=replace(diagnosis.driver, column="rate and heat and cold"))
    assert {name for name, followed in panels(both) if followed} == {"residual-rate", "residual-heat-and-cold"}


def test_over_time_residuals_lie_on_the_curve_that_was_found(rng: np.random.Generator):
    """The curve is of the time in each campaign, wherever the clock of its file began."""
    parts = [rate_table(rng) for _ in range(2)]
    parts = [c.with_column("time", c.columns["time"] + 5e4 * (i + 1), "s") for i, c in enumerate(parts)]
    data = search_data(parts)
    since = np.concatenate([c.columns["time"] - c.columns["time"][0] for c in parts])
    x = np.linspace(0.0, since.max(), 80)
    driver = Driver("time", "s", x, 1e-3 * np.sin(x / 900.0), np.full(80, 3e-5), "deg/s")
    base = made(data.whole, 1e-3 * np.sin(since / 900.0), 1.1e-4, rng)
    extended = Fitted(GIVEN, record=data.record)
    diagnosis = replace(base, verdict="unknown", causes=(), driver=driver, extended=extended)
    at = _column(diagnosis, {})
    assert at is not None
    assert at == pytest.approx(since)
    means = bins(at, diagnosis.residual_before)
    assert means.mean == pytest.approx(np.interp(means.x, driver.x, driver.y) - driver.y.mean(), abs=2e-4)
    [drawn] = figures(diagnosis).driver
    assert "Squares" in drawn.caption
    assert "time since the start" in drawn.svg


def held_at(diagnosis: Diagnosis, *rows: tuple[str, str, float, float, str], **change: Any) -> Diagnosis:
    """The diagnosis of a simulation that holds these parameters fixed, beside the scale factor it fits."""
    return replace(diagnosis, baseline=Fitted((GIVEN[0], *rows)), **change)


BIAS = Cause("bias", (ParameterValue("value", 5.0, 0.02, "deg/h", (4.9, 5.04)),), 90.0, 1e-30, 1e-29, 0.99)


def test_an_effect_held_at_a_wrong_value_is_not_called_missing(rng: np.random.Generator, tmp_path: Path):
    fixed = ("bias", "value", 4.0, 0.0, "deg/h")
    diagnosis = held_at(named(rng), fixed, causes=(BIAS,))
    assert sentence(diagnosis).startswith(
        "Your simulation holds the bias at 4 deg/h, where the data say (5.000 ± 0.020) deg/h; with that the error on"
    )
    text = words(write_report(diagnosis, tmp_path)[0])
    assert "Your simulation holds it at 4 deg/h." in text
    assert "Only because it is as far off as this was it told" in text
    assert "4.00000 deg/h (fixed)" in text
    both = sentence(replace(diagnosis, causes=(SHUPE, BIAS)))
    assert (
        "lacks a temperature-rate bias of (0.0981 ± 0.0030) deg/s per °C/s, and holds the bias at 4 deg/h, where"
        in both
    )
    assert "; with them the error" in both
    fitted = replace(diagnosis, baseline=Fitted(GIVEN))
    assert sentence(fitted).startswith("Your simulation lacks a constant bias of (5.000 ± 0.020) deg/h; with it")
    assert "holds it at" not in words(write_report(fitted, tmp_path)[0])


@pytest.mark.parametrize(
    ("unit", "before", "value", "std", "text"),
    [
        ("1", 0.98, 0.98102, 2e-5, "the scale factor at 0.98, where the data say 0.981020 ± 0.000020;"),
        (
            "count/deg",
            1000.0,
            1001.2,
            0.02,
            "the scale factor at 1000 count/deg, where the data say (1001.200 ± 0.020)",
        ),
    ],
)
def test_a_scale_factor_held_at_a_wrong_value_is_told_beside_it(
    unit: str, before: float, value: float, std: float, text: str, rng: np.random.Generator
):
    cause = replace(BIAS, effect="scale_factor", parameters=(ParameterValue("value", value, std, unit),))
    rows = (("scale_factor", "value", before, 0.0, unit),)
    diagnosis = replace(named(rng), causes=(cause,), baseline=Fitted(rows))
    assert f"Your simulation holds {text}" in sentence(diagnosis)
    missing = sentence(replace(diagnosis, baseline=Fitted(())))
    said = "a scale-factor error of (-18980 ± 20) ppm" if unit == "1" else "a scale factor of (1001.200 ± 0.020)"
    assert f"Your simulation lacks {said}" in missing


def test_several_held_values_are_told_by_name_and_many_are_not(rng: np.random.Generator):
    rows = (
        ("bias_periodic", "cosine", 0.5, 0.0, "deg/h"),
        ("bias_periodic", "sine", 0.0, 0.0, "deg/h"),
        ("bias_periodic", "frequency", 0.0004, 0.0, "Hz"),
        ("bias_temperature_curve", "coefficient[0]", 1.0, 0.0, "deg/h"),
    )
    curve = replace(SHUPE, effect="bias_temperature_curve", parameters=(ParameterValue("slope[0]", 2.0, 0.1, "deg/h"),))
    diagnosis = held_at(named(rng), *rows, causes=(PERIODIC, curve))
    assert (
        "holds the periodic bias at cosine 0.5 deg/h, sine 0 deg/h and frequency 4e-4 Hz, where the data say cosine "
        "(0.610 ± 0.080) deg/h, sine (-0.221 ± 0.079) deg/h and frequency (4.120 ± 0.020)e-4 Hz, and the bias that "
        "curves with temperature at values that the data contradict; with these the error"
    ) in sentence(diagnosis)


def test_held_values_are_told_with_other_verdicts_too(rng: np.random.Generator):
    fixed = ("bias", "value", 4.0, 0.0, "deg/h")
    part = held_at(unknown(rng), fixed, causes=(BIAS,))
    assert "though the bias at (5.000 ± 0.020) deg/h instead of 4 deg/h would take up part of it" in sentence(part)
    doubtful = ambiguous(rng, 2000)
    share = {"bias": 0.5, "bias_drift": 0.4}
    alike = held_at(doubtful, fixed, causes=(BIAS, doubtful.causes[0]), credible_set=share)
    assert "a constant bias other than the simulation's or a bias drift in time" in sentence(alike)
    sure = held_at(doubtful, fixed, causes=(BIAS, *doubtful.causes))
    assert sentence(sure).startswith("Your simulation holds the bias at 4 deg/h, where the data say (5.000 ± 0.020)")


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (4.0 * (1.0 + 1e-15), "deg/h", "4 deg/h"),
        (1000.012, "count/deg", "1000.012 count/deg"),
        (-3e-6, "", "-3e-6"),
        (0.0, "deg/h", "0 deg/h"),
        (150000.0, "count", "1.5e5 count"),
        (1.0 / 3.0, "V", "0.3333333333 V"),
    ],
)
def test_stated_values_are_told_in_the_digits_they_have(value: float, unit: str, text: str):
    assert stated(value, unit) == text


def found_of(diagnosis: Diagnosis) -> dict[str, str]:
    """What the table of searched names says was found of each."""
    return {row["title"]: row["found"] for row in context(diagnosis)["searched"]}


def test_what_was_searched_says_what_was_found_of_each(rng: np.random.Generator, tmp_path: Path):
    names = (*SEARCHED, "scale_factor", "bias", "smooth(temperature)", "smooth(rate, d(rate)/dt)")
    diagnosis = replace(unknown(rng), searched=names)
    found = found_of(diagnosis)
    assert found["Some smooth function of temperature"] == "followed"
    assert found["Some smooth function of rate and angular acceleration"] == ""
    assert not {"Scale-factor error", "Constant bias"} & set(found)
    assert "smooth(" not in words(write_report(diagnosis, tmp_path)[0])
    assert diagnosis.driver is not None
    pair_of = replace(diagnosis.driver, column="rate and d(rate)/dt")
    found = found_of(replace(diagnosis, driver=pair_of, credible_set={"smooth(rate, d(rate)/dt)": 1.0}))
    assert found["Some smooth function of rate and angular acceleration"] == "followed"
    assert found["Some smooth function of temperature"] == ""


def test_what_the_simulation_has_and_more_was_looked_for_stays_in_the_table(rng: np.random.Generator):
    names = (*SEARCHED, "scale_factor", "bias")
    wider = replace(named(rng), searched=names, minimum_detectable=DETECTABLE | {"scale_factor": (1.2, "ppm")})
    assert found_of(wider)["Scale-factor error"] == ""
    assert found_of(replace(wider, causes=(BIAS,)))["Constant bias"] == "named"
    assert sentence(replace(adequate(rng), searched=names)).startswith(
        "Nothing is missing that this campaign could show: 13 effects were"
    )


def test_what_may_be_is_possible_and_what_is_sure_is_named(rng: np.random.Generator):
    diagnosis = ambiguous(rng, 2000)
    share = {"bias_drift": 0.52, "bias_warmup": 0.44}
    found = found_of(replace(diagnosis, causes=(diagnosis.causes[0], SHUPE), credible_set=share))
    assert (found["Bias drift in time"], found["Warm-up bias"]) == ("possible", "possible")
    assert found["Temperature-rate bias"] == "named"
    assert found["Step of the bias"] == ""


def test_each_step_stands_beside_its_own_value(rng: np.random.Generator):
    first, second = (("bias_step", "size", value, 0.1, "deg/h") for value in (1.0, 2.0))
    new = ("bias_step", "size", 7.0, 0.1, "deg/h")
    diagnosis = replace(named(rng), baseline=Fitted((first, second)), extended=Fitted((first, second, new)))
    rows = context(diagnosis)["parameters"]
    assert [row["before"] for row in rows] == ["(1.00 ± 0.10) deg/h", "(2.00 ± 0.10) deg/h", "not in it"]
    assert [row["new"] for row in rows] == [False, False, True]


def test_a_covariate_whose_name_begins_as_the_output_is_drawn(rng: np.random.Generator):
    diagnosis = named(rng)
    campaign = diagnosis.campaign.with_column("output_power", rng.normal(size=430), "W")
    names = [name for name, _ in panels(replace(diagnosis, campaign=campaign))]
    assert "residual-output-power" in names
    assert "residual-output" not in names


@pytest.mark.long
def test_a_platform_is_not_told_of_commands_for_gyros(rng: np.random.Generator, tmp_path: Path):
    diagnosis = named(rng)
    assert "gyromodel compensate" in words(write_report(diagnosis, tmp_path)[0])
    platform = replace(diagnosis, extended=Fitted(GIVEN, domain="platform"))
    text = words(write_report(platform, tmp_path)[0])
    assert "gyromodel diagnose CAMPAIGN --model model.yaml" in text
    assert not re.search("gyromodel (simulate|compensate|export)|range of temperature", text)


def test_gaps_of_the_record_are_told(rng: np.random.Generator, tmp_path: Path):
    diagnosis = named_static(rng, 3000)
    assert "3 000 samples with a gap of 1506 s" in words(write_report(diagnosis, tmp_path)[0])
    rows = np.arange(3000)
    kept = (rows < 400) | (rows >= 2200)
    facts = lambda campaign: context(replace(diagnosis, campaign=campaign))["facts"]  # noqa: E731
    assert facts(diagnosis.campaign.select(kept))[-1] == "1\u202f200 samples with a gap of 3.42 h"
    twice = kept & ((rows < 2500) | (rows >= 2600))
    assert facts(diagnosis.campaign.select(twice))[-1] == "1\u202f100 samples with 2 gaps, the longest 3.42 h"
    assert facts(named(rng).campaign)[-1] == "430 samples"


def test_joined_campaigns_of_other_intervals_have_no_gaps(rng: np.random.Generator):
    fast, slow = static_log(rng, 3000).select(slice(1000)), rate_table(rng)
    slow = slow.select(slice(200))
    time = np.append(fast.columns["time"], fast.columns["time"][-1] + 1.0 + slow.columns["time"])
    columns = {"time": time, "output": rng.normal(size=1200), "campaign": np.repeat([1.0, 2.0], [1000, 200])}
    joined = Campaign(columns, {"time": "s", "output": "deg/s", "campaign": ""}, {"kind": "rate"})
    assert context(replace(named(rng), campaign=joined))["facts"][-1] == "1\u202f200 samples"


def test_the_history_of_three_axes_is_told_as_that_of_the_first():
    time = np.linspace(1.0, 100.0, 50)
    alone = {f"{axis} bias value": (axis == "x") * 1e-3 * time for axis in "xyz"}
    svg = history_figure(Sensitivity((), History(time, 1e-3 * time, alone), (), ()))
    assert "all of axis x, with their correlations" in svg
    assert "angle about x, standard uncertainty" in svg
    assert "y bias" not in svg
    svg = history_figure(Sensitivity((), History(time, 1e-3 * time, {"bias value": 1e-3 * time}), (), ()))
    assert "all, with their correlations" in svg
    assert "axis x" not in svg
