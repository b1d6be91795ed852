"""The noise of a campaign at rest: deviations over averaging time and identified noise terms, in units of reports."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np

from gyromodel._checks import CampaignError
from gyromodel._output_rate import rate_output, rate_scale
from gyromodel.campaign import Campaign
from gyromodel.noise import NOISE_UNITS as _STATED_UNITS
from gyromodel.noise import Deviation, Estimator, IdentifiedNoise, deviation, identify_noise, usual_interval, with_gaps
from gyromodel.numerics.rounding import quantum
from gyromodel.units import UnitError, convertible, factor, internal_unit

# A reference rate that changes by more (deg/s) is a test at speed.
AT_REST = 0.01
# Averages that end below this part of the longest possible are said to.
SHORTENED = 0.25
LENGTHS_PER_DECADE = 10
RATE_UNIT = "deg/h"
# Units of the coefficients of an angular rate, and for any other output what the rate's unit is multiplied by.
UNITS = _STATED_UNITS | {
    "noise_quantisation": "arcsec",
    "noise_markov": "deg/h/sqrt(h)",
    "noise_rate_ramp": "deg/h/h",
}
_BY_RATE = {
    "noise_white": "/sqrt(Hz)",
    "noise_quantisation": "*s",
    "noise_flicker": "",
    "noise_random_walk": "/sqrt(s)",
    "noise_markov": "/sqrt(s)",
    "noise_rate_ramp": "/s",
}
SYMBOLS = {
    "noise_white": "N",
    "noise_quantisation": "Q",
    "noise_flicker": "B",
    "noise_random_walk": "K",
    "noise_markov": "q",
    "noise_rate_ramp": "R",
}


@dataclass(frozen=True)
class NoiseAnalysis:
    """Deviations by estimator and the identified noise, in the rate's internal unit; `unit` is that of reports.

    `quantum` is the step of the grid that the output lies on, in the unit of its file; None without one.
    """

    name: str
    deviations: Mapping[str, Deviation]
    noise: IdentifiedNoise
    rate_unit: str
    unit: str
    remarks: tuple[str, ...]
    data_hash: str
    quantum: float | None = None

    def unit_of(self, term: str) -> str:
        """Unit in which a coefficient is reported."""
        if self.unit == RATE_UNIT:
            return UNITS[term]
        if term == "noise_quantisation" and self.rate_unit.endswith("/s"):
            return self.rate_unit.removesuffix("/s")
        return self.rate_unit + _BY_RATE[term]

    def scale_of(self, term: str) -> float:
        """What a coefficient is multiplied by to be in that unit."""
        return factor(internal_unit(UNITS[term]), UNITS[term]) if self.unit == RATE_UNIT else 1.0

    @property
    def scale(self) -> float:
        """What a rate is multiplied by to be in the unit of reports."""
        return factor(self.rate_unit, self.unit)

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain data."""
        terms = {}
        for key, term in self.noise.terms.items():
            size = self.scale_of(key)
            known = term.verdict != "not identifiable"
            terms[key] = {
                "symbol": SYMBOLS[key],
                "verdict": term.verdict,
                "value": term.value * size if known else None,
                "ci95": [term.low * size, term.high * size] if known else None,
                "bound": None if known or not np.isfinite(term.high) else term.high * size,
                "unit": self.unit_of(key),
                "alternatives": list(term.alternatives),
                "in_model": term.in_model,
            }
        markov = self.noise.terms["noise_markov"]
        terms["noise_markov"]["time_constant_s"] = markov.time_constant
        terms["noise_markov"]["bounds"] = [
            {"time_constant_s": c, "bound": b * self.scale_of("noise_markov")} for c, b in markov.bounds
        ]
        return {
            "campaign": self.name,
            "unit": self.unit,
            "deviations": {
                name: {
                    "tau_s": d.tau,
                    "deviation": d.deviation * self.scale,
                    "low": d.low * self.scale,
                    "high": d.high * self.scale,
                    "terms": d.terms,
                    "degrees_of_freedom": d.degrees_of_freedom,
                    "noise_exponent": d.exponent,
                }
                for name, d in self.deviations.items()
            },
            "noise": terms,
            "lines": [
                {
                    "frequency_hz": x.frequency,
                    "frequency_std_hz": x.frequency_std,
                    "amplitude": x.amplitude * self.scale,
                    "std": x.std * self.scale,
                }
                for x in self.noise.lines
            ],
            "fits": self.noise.fits,
            "approximate": self.noise.approximate,
            "misfits": [{"from_hz": a, "to_hz": b, "measured_over_fitted": r} for a, b, r in self.noise.misfits],
            "remarks": list(self.remarks),
            "quantum": self.quantum,
            "data_hash": self.data_hash,
        }


def analyse_noise(campaign: Campaign, progress: Callable[[str, float], None] | None = None) -> NoiseAnalysis:
    """Deviations and identified noise of a campaign at rest or at a constant rate.

    Args:
        campaign: one axis; increments and angles become rates first. Metadata `nominal_scale_factor`, such as
            `1000 count/deg`, turns raw outputs into rates; without it results are in the output's unit.
        progress: called with a line and the fraction done.

    Returns:
        Deviations and noise terms, with remarks on what they do not cover.

    Raises:
        CampaignError: the output shows no noise, or the campaign has several axes.
    """
    rate, unit = rate_output(campaign)
    turning = campaign.in_unit("rate", "deg/s") if "rate" in campaign.columns else np.zeros(1)
    turning = turning[np.isfinite(turning)]
    turned = np.ptp(turning) if len(turning) else np.nan
    if not turned <= AT_REST:
        found = f"changes by {turned:.3g} deg/s" if np.isfinite(turned) else "is not known"
        raise CampaignError(f"{campaign.name}: column 'rate' {found}, but noise is read at a constant rate")
    time, remarks = campaign.si("time"), []
    if not convertible(unit, RATE_UNIT):
        nominal = _nominal(campaign, unit)
        if nominal is None:
            remarks.append(f"There is no nominal_scale_factor, so that results are in the output's unit, {unit}.")
        else:
            rate, unit = rate / nominal, "rad/s"
            remarks.append(
                f"Rates are outputs over the nominal_scale_factor, {campaign.metadata['nominal_scale_factor']}."
            )
    try:
        noise = identify_noise(rate, time, progress=progress)
    except ValueError as error:
        raise CampaignError(f"{campaign.name}: {error}") from error
    known = np.isfinite(rate)
    interval = usual_interval(time[known])
    even = with_gaps(rate[known], time[known], interval)
    most = max(len(even) // 2, 1)
    lengths = np.unique(np.geomspace(1, most, int(LENGTHS_PER_DECADE * np.log10(most)) + 2).round().astype(int))
    deviations = {name: deviation(even, interval, name, lengths) for name in get_args(Estimator)}
    reached = deviations["allan"].tau.max(initial=0.0)
    if reached < SHORTENED * len(even) * interval / 2:
        remarks.append(f"Missing samples leave no complete averages longer than {reached:.3g} s.")
    if not noise.fits:
        remarks.append(_misfit(noise))
    if noise.approximate:
        remarks.append(
            "The noise is coloured from the shortest times on and the record is long: its likelihood is approximate, "
            "and intervals are too short."
        )
    step = quantum(campaign.columns["output"])
    if step is not None:
        remarks.append(f"The output comes in steps of {step:.4g} {campaign.units['output']}.")
    shown = RATE_UNIT if unit == "rad/s" else unit
    return NoiseAnalysis(campaign.name, deviations, noise, unit, shown, tuple(remarks), campaign.digest(), step)


def _nominal(campaign: Campaign, unit: str) -> float | None:
    """The nominal scale factor in the output's internal unit over rad/s."""
    stated = campaign.metadata.get("nominal_scale_factor")
    if stated is None:
        return None
    try:
        return rate_scale(str(stated), unit)
    except UnitError as error:
        raise CampaignError(
            f"{campaign.name}: metadata nominal_scale_factor is '{stated}', expected the output over an angular rate, "
            f"such as '1000 {unit.removesuffix('/s')}/deg' ({error})"
        ) from error


def _misfit(noise: IdentifiedNoise) -> str:
    """What the model does not explain, in a sentence."""
    said = []
    if noise.misfits:
        low, high, ratio = max(noise.misfits, key=lambda m: abs(np.log(m[2])))
        said.append(f"from {low:.3g} to {high:.3g} Hz the measured power is {ratio:.2g} of the fitted one")
    if noise.more_lines:
        said.append(f"there are more than {len(noise.lines)} lines")
    return f"The noise is not of these kinds: {', and '.join(said)}. Coefficients only describe, they do not predict."
