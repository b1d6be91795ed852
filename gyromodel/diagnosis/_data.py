"""What is searched of measured campaigns: means, poses and reference rates of gyros, angles of a platform's base."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel._checks import CampaignError
from gyromodel.attitude import refuse_navigated, with_reference_rates
from gyromodel.averages import MAXIMUM_ROWS, MEAN_OF_ATTITUDE, MOST_TURN, as_rate, average, turning
from gyromodel.campaign import Campaign
from gyromodel.diagnosis._readings import Readings, readings_of
from gyromodel.diagnosis._variance import steps_of_output, thermometers_still, without_still
from gyromodel.numerics.stretches import stretches_of
from gyromodel.platform import GIMBALS, is_platform, vibration_record
from gyromodel.poses import at_rest
from gyromodel.signals import MOST_BLOCKS, Record, columns_apart, read_signals, time_since_power_on
from gyromodel.units import convertible

# What a pose tells is in its mean: within it, means over so long (s) are enough, and keep out a hand's tremor.
MEAN_OF_POSE = 1.0
# Rows that are searched of several campaigns together, and values of their columns: 4 GB of memory.
MOST_ROWS, MOST_VALUES = 40_000, 320_000
# Part of its range within which a column stands still in a stretch; stretches that may be runs, fewer than are dwells.
STILL, MOST_STRETCHES = 0.1, 11
# Told where it matters.
NO_RUNS = (
    "There is no column run: each stretch between gaps counts as one. A model with bias_turn_on is applied to files "
    "that have the column."
)


@dataclass(frozen=True)
class Data:
    """A record to search and where it comes from.

    Attributes:
        record: the signals.
        searched: the campaigns that a further test could repeat; none of a platform.
        rows_of: the campaigns that rows are told of, and whether they are as given.
        whole: one campaign with the record's rows, which reports show.
        findings: what was done to the measured data, in sentences.
        unit: that errors are told in.
        output_unit: that of the output as it was recorded, a rate or of a platform an angle.
        step: of the coarsest reading that the output is computed from, internal units; zero where none shows.
        readings: how a gyro's output is read.
        stepped: findings on that, for where its steps are no cause.
        time_on: where no column numbers runs, the signal `time_on` if the gyro was off in every gap; none without gaps.
    """

    record: Record
    searched: tuple[Campaign, ...]
    rows_of: tuple[tuple[Campaign, bool], ...]
    whole: Campaign
    findings: tuple[str, ...]
    unit: str
    output_unit: str
    step: float = 0.0
    readings: Readings = field(default_factory=Readings)
    stepped: tuple[str, ...] = ()
    time_on: Float[Array, " sample"] | None = None


def read(measured: Sequence[Campaign], without: str = "") -> Data:
    """Campaigns of one gyro, or logs of one platform without runs about some axis, as they are searched."""
    if not measured:
        raise CampaignError("there is no campaign to look at")
    of_platform = [is_platform(c) for c in measured]
    if all(of_platform):
        test = vibration_record(measured, without)
        rows_of = ((test.campaign, False),)
        return Data(test.record, (), rows_of, test.campaign, test.findings, "deg", "deg", test.step)
    if any(of_platform):
        raise CampaignError(f"{measured[of_platform.index(True)].name} is of a platform, and others are of a gyro")
    return _of_gyro(measured)


def _of_gyro(measured: Sequence[Campaign]) -> Data:
    for campaign in measured:
        if not campaign.outputs:
            named = ", ".join(GIMBALS)
            raise CampaignError(f"{campaign.name}: there is no column 'output', and a platform's gimbals are {named}")
    refuse_navigated(measured)
    as_given, measured = measured, [_with_runs(measured[0])] if len(measured) == 1 else measured
    given, of_attitude = zip(*(with_reference_rates(c) for c in measured), strict=True)
    given, still = zip(*(without_still(c) for c in given), strict=True)
    campaigns = [at_rest(c) for c in given]
    findings = [line for line in of_attitude if line]
    if "run" in measured[0].columns and "run" not in as_given[0].columns:
        findings.append(NO_RUNS)
    findings += [
        f"{len(np.unique(posed.columns['position']))} static poses were found in {c.name}; {len(c) - len(posed)} rows "
        "in motion were left out."
        for c, posed in zip(given, campaigns, strict=True)
        if posed is not c
    ]
    shortened = [
        average(c, most, MEAN_OF_POSE if c is not g else MEAN_OF_ATTITUDE * (g is not m))
        for c, g, m, most in zip(campaigns, given, measured, _most_rows(campaigns), strict=True)
    ]
    if any(m > 1 for _, m in shortened):
        most = max(m for _, m in shortened)
        shortened = [(as_rate(c), m) for c, m in shortened]
        findings.append(
            f"Means of {most} consecutive samples were searched: lines above half their sample rate and quantisation "
            "are averaged away."
        )
    far = dict.fromkeys(n for c, (_, m) in zip(campaigns, shortened, strict=True) for n in turning(c, m))
    findings += [f"{n} turns by more than {MOST_TURN:g} deg within a mean, which weakens what follows it." for n in far]
    findings += [
        f"The first {len(c)} of {len(g)} rows were searched: means tell nothing of the feedback ramp's codes."
        for g, (c, m) in zip(campaigns, shortened, strict=True)
        if m == 1 and len(c) < len(g)
    ]
    findings += [line for line in still if line]
    stepped = tuple(line for c in given if (line := steps_of_output(c)))
    findings += [line for c in given for line in thermometers_still(c)]
    searched = tuple(c for c, _ in shortened)
    record = read_signals(searched)
    findings += [
        f"{n} is in only some of the campaigns: it was not searched."
        for n in columns_apart(searched)
        if n != "campaign"
    ]
    if any(m > 1 for _, m in shortened):
        record = _of_means(record, campaigns, searched)
    time_on = None
    if len(as_given) == 1 and "run" not in as_given[0].columns:
        time_on = _since_gaps(record, searched[0])
        record = _without_power_cycles(record, searched[0]) if "run" in searched[0].columns else record
    output_unit = campaigns[0].units["output"]
    if campaigns[0].metadata["kind"] != "rate":
        output_unit = f"{output_unit}/s"
    whole = searched[0] if len(searched) == 1 else _together(searched)
    rows_of = tuple((c, len(c) == len(m)) for c, m in zip(searched, measured, strict=True))
    readings = readings_of(campaigns, searched)
    unit = _rate_unit(campaigns[0])
    return Data(record, searched, rows_of, whole, tuple(findings), unit, output_unit, 0.0, readings, stepped, time_on)


def _most_rows(campaigns: Sequence[Campaign]) -> list[int]:
    """How many rows of each campaign are searched, as memory goes with the rows of all and with what is logged."""
    total, logged = sum(map(len, campaigns)), max(len(c.covariates) for c in campaigns)
    together = min(MOST_ROWS, MOST_VALUES // max(logged, 1))
    return [min(MAXIMUM_ROWS, -(-len(c) * together // max(total, together))) for c in campaigns]


def _without_power_cycles(record: Record, campaign: Campaign) -> Record:
    """The record of one campaign, its runs being stretches: nothing tells that the gyro was off between them."""
    time_on = record.signals["time"] + time_since_power_on(campaign)
    return record._replace(signals=record.signals | {"time_on": time_on})


def _since_gaps(record: Record, campaign: Campaign) -> Float[Array, " sample"] | None:
    """Time since power-on had the gyro been off in each gap; none without one, or with too many for power cycles."""
    time = np.asarray(record.signals["time"])
    stretch = stretches_of(time[: record.rows])
    if not 0 < stretch.max() < MOST_BLOCKS:
        return None
    begins = time[np.searchsorted(stretch, np.arange(stretch.max() + 1))]
    since = time - np.pad(begins[stretch], (0, len(time) - record.rows), mode="edge")
    # Each start was recorded as late as the first.
    return jnp.asarray(since + begins[0] + time_since_power_on(campaign))


def _of_means(record: Record, campaigns: Sequence[Campaign], means: Sequence[Campaign]) -> Record:
    """The record of means, in time since the first samples; of each how many samples it is of, and how far apart.

    The means of a line are smaller than it by as much as its phase turns within them (`BiasPeriodic`).
    """
    steps = [float(np.median(np.diff(c.si("time")[np.isfinite(c.columns["output"])]))) for c in campaigns]
    late = [float(m.si("time")[0] - c.si("time")[0]) for c, m in zip(campaigns, means, strict=True)]
    counts = [max(round(float(np.median(np.diff(m.si("time")))) / s), 1) for m, s in zip(means, steps, strict=True)]
    rows, extra = [len(m) for m in means], len(record.sampling.present) - record.rows
    by_row = (np.pad(np.repeat(np.array(x, float), rows), (0, extra), mode="edge") for x in (late, counts, steps))
    offset, averaged, step = map(jnp.asarray, by_row)
    moved = {name: record.signals[name] + offset for name in ("time", "time_on")}
    return record._replace(signals=record.signals | moved | {"_averaged": averaged, "_step": step})


def _with_runs(campaign: Campaign) -> Campaign:
    """The campaign with its stretches between gaps numbered as runs, where no column does and they may be power cycles.

    Not where a column stands still in each: soaks at one temperature are no runs, and what follows the temperature is
    no offset of theirs. A column that drifts through many stretches stands still in each of them.
    """
    stretches = stretches_of(campaign.columns["time"])
    if "run" in campaign.columns or not 0 < stretches.max() < MOST_STRETCHES:
        return campaign
    for values in (campaign.columns[name] for name in campaign.covariates):
        known = np.isfinite(values)
        own, stretch = values[known], stretches[known]
        parts = np.split(own, np.flatnonzero(np.diff(stretch)) + 1)
        if own.size and np.median([np.ptp(part) for part in parts]) < STILL * np.ptp(own):
            return campaign
    return campaign.with_column("run", 1.0 + stretches, "")


def _rate_unit(campaign: Campaign) -> str:
    """The unit errors are reported in: the output's if it is a rate, else the rate column's, else deg/s."""
    for name in ("output", "rate"):
        if name in campaign.units and convertible(campaign.units[name], "rad/s"):
            return campaign.units[name]
    return "deg/s"


def _together(campaigns: Sequence[Campaign]) -> Campaign:
    first = campaigns[0]
    names = [n for n in first.columns if n != "time" and n not in columns_apart(campaigns)]
    columns = {"time": [], **{n: [] for n in names}}
    start = 0.0
    for campaign in campaigns:
        time = campaign.in_unit("time", first.units["time"])
        columns["time"].append(time - time[0] + start)
        start = columns["time"][-1][-1] + np.median(np.diff(time))
        for name in names:
            columns[name].append(campaign.in_unit(name, first.units[name]))
    units = {n: first.units[n] for n in columns}
    named = f"{first.name} and {campaigns[1].name if len(campaigns) == 2 else f'{len(campaigns) - 1} more'}"
    whole = Campaign({n: np.concatenate(v) for n, v in columns.items()}, units, first.metadata, named)
    number = np.repeat(1.0 + np.arange(len(campaigns)), [len(c) for c in campaigns])
    return whole if "campaign" in names else whole.with_column("campaign", number, "")
