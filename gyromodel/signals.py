"""What effects see of a campaign: columns in internal units, time since the start, derived signals, and the sampling.

Arrays are padded to a few fixed lengths, so that compiled functions serve every campaign; padded rows count as missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gyromodel._checks import NUMBERED, CampaignError, thermometers
from gyromodel._output_rate import rate_output
from gyromodel.campaign import Campaign
from gyromodel.effects._base import Domain
from gyromodel.numerics.state_space import Sampling
from gyromodel.numerics.stretches import derivative_by_stretch, smooth_by_stretch, stretches_of
from gyromodel.units import UnitError, convertible, factor, quantity

# A step this many times the median within runs, where a run begins, is time in which the gyro was off.
OFF = 1.5
# Rounding errors of one sample that stand for all on the way from what was measured to what is compared; the sample is
# larger than this part of them, as a single one may be a fill value.
ROUNDED, USUAL = 4.0, 0.99
# Longer records are padded less: the work outweighs the compiling.
FINER_FROM = 4096
# How far most of the samples of a clock are from whole steps of it, in steps.
JITTER = 0.05
# A column missing in more than this share of the rows is not searched; rows without one of the others are left out, up
# to a share of them for all columns together.
MOST_MISSING, MOST_LEFT_OUT = 0.2, 0.5
# Whose squares heat a thermometer.
RATES = ("rate", "rate_x", "rate_y", "rate_z")
# Stretches that are held out one by one, and may be power cycles.
FEWEST_BLOCKS, MOST_BLOCKS = 4, 60


def domain_of(output_unit: str) -> Domain:
    """Whose output is in an internal unit: a platform's base is measured by its angle, and gyros by rates."""
    return "platform" if output_unit == "rad" else "gyro"


class Record(NamedTuple):
    """Signals of one or several campaigns of one unit, laid end to end.

    `output` is a rate-type output (increments divided by their interval, angles differenced), or of a platform the
    angle of its base less that of the table; `rows` is the number of
    real rows before padding; `interval` the usual time (s) between rows with an output; `units` the file's units by
    column; `blocks` numbers the stretches that replicate one another; `in_steps` says that each sample of the rate was
    read in steps of its own, which no angle's count explains.
    """

    signals: dict[str, Float[Array, " sample"]]
    sampling: Sampling
    rows: int
    interval: float
    output_unit: str
    units: dict[str, str]
    blocks: np.ndarray
    block_scheme: str
    data_hash: str = ""
    in_steps: bool = False

    @property
    def domain(self) -> Domain:
        """Whether it is of a gyro or of a platform."""
        return domain_of(self.output_unit)

    @property
    def input_unit(self) -> str:
        """The internal unit of what is measured: a rate, or of a platform an angle."""
        return "rad" if self.domain == "platform" else "rad/s"

    @property
    def span(self) -> float:
        """Time from first to last sample (s), at least two intervals."""
        time = np.asarray(self.signals["time"])[: self.rows]
        return float(max(np.max(time) - np.min(time), 2 * self.interval))

    @property
    def present(self) -> np.ndarray:
        """Real rows with an output."""
        return np.asarray(self.sampling.present)[: self.rows]

    @property
    def imprecision(self) -> float:
        """The variance that double precision leaves of a sample: its rounding, and that of what it is compared with.

        Never 0, as the outputs themselves may be: what a fit leaves is divided by it.
        """
        sizes = np.sort(np.abs(np.asarray(self.signals["output"])[: self.rows][self.present]))
        size = float(sizes[int(USUAL * (len(sizes) - 1))]) if len(sizes) else 0.0
        return max((ROUNDED * np.finfo(float).eps * size) ** 2, float(np.finfo(float).tiny))

    @property
    def run(self) -> np.ndarray:
        """Each sample's run, counted from 0; padding belongs to the last."""
        return np.cumsum(np.asarray(self.sampling.restart)) - 1

    @property
    def run_numbers(self) -> tuple[int, ...]:
        """Of each run the number in `campaign`, by which effects know it: 0 where there is one run; none without."""
        run = self.run[: self.rows]
        if run[-1] == 0:
            return (0,)
        number = np.asarray(self.signals.get("campaign", np.zeros(len(self.run))))[: self.rows]
        first = number[np.unique(run, return_index=True)[1]]
        alone = len(np.unique(first)) == len(first) and (number == first[run]).all()
        return tuple(map(int, first)) if alone and np.isin(first, range(1, 100)).all() else ()

    def without(self, rows: np.ndarray) -> Record:
        """The same record with some rows treated as missing."""
        drop = np.zeros(len(self.sampling.present), bool)
        drop[: self.rows][rows] = True
        return self._replace(sampling=self.sampling._replace(present=self.sampling.present & ~drop))


def padded_length(rows: int) -> int:
    """The rows rounded up to a quarter of a power of two, those of thousands to a sixteenth."""
    step = max(2 ** (max(rows, 64).bit_length() - (3 if rows <= FINER_FROM else 5)), 16)
    return -(-rows // step) * step


def _blocks(campaign: Campaign, time: np.ndarray) -> tuple[np.ndarray, str]:
    """Stretches that replicate the driver: runs between gaps, else the segment or run column, else equal parts."""
    stretches = stretches_of(time)
    if FEWEST_BLOCKS <= stretches.max() + 1 <= MOST_BLOCKS:
        return stretches, "stretches between gaps"
    for name in NUMBERED:
        if name in campaign.columns:
            values = campaign.columns[name]
            numbers = np.unique(values, return_inverse=True)[1]
            if FEWEST_BLOCKS <= numbers.max() + 1 <= MOST_BLOCKS:
                return numbers, f"{name}s"
    parts = (np.arange(len(time)) * 5) // len(time)
    return parts, "fifths of the record"


def read_signals(campaigns: Sequence[Campaign] | Campaign) -> Record:
    """Lay campaigns of one unit end to end as padded signals in internal units.

    Raises:
        CampaignError: columns, units or kinds of the campaigns do not match.
    """
    campaigns = [campaigns] if isinstance(campaigns, Campaign) else list(campaigns)
    _check_alike(campaigns)
    apart = columns_apart(campaigns)
    names = ["time", *(name for name in campaigns[0].covariates if name not in apart)]
    runs = _counted_on([c.si("run") for c in campaigns]) if "run" in names else []
    parts: dict[str, list[np.ndarray]] = {}
    blocks, schemes, unit = [], set(), ""
    for campaign in campaigns:
        time = campaign.si("time")
        output, unit = rate_output(campaign)
        columns = {n: campaign.si(n) for n in names}
        if runs:
            columns["run"] = runs[len(blocks)]
        columns["time"] = time - time[0]
        columns["time_on"] = _time_on(campaign, time)
        for name in thermometers(names):
            columns[f"{name}_rate"] = derivative_by_stretch(time, columns[name])
        if len(campaigns) > 1 and "campaign" not in names:
            columns["campaign"] = np.full(len(time), 1.0 + len(blocks))
        columns["output"] = output
        step = np.diff(time, prepend=time[0])
        columns["_interval"], columns["_restart"] = step, np.arange(len(time)) == 0
        for name, values in columns.items():
            parts.setdefault(name, []).append(values)
        block, scheme = _blocks(campaign, time)
        blocks.append(block + (blocks[-1].max() + 1 if blocks else 0))
        schemes.add(scheme)
    signals = {n: np.concatenate(v) for n, v in parts.items()}
    if len(campaigns) > 1:
        # White noise is the same in all of them, and its samples scatter less where they are further apart. Where some
        # have no clock, a sample of any counts as one of another.
        step = _usual_step(*(signals[n] for n in ("_interval", "_restart", "output")))
        each = [_own_step(*own) for own in zip(*(parts[n] for n in ("_interval", "_restart", "output")), strict=True)]
        white = [step / own for own in each if own is not None]
        if len(white) == len(each):
            signals["_white"] = np.repeat(white, [len(v) for v in parts["output"]])
    units = {"campaign": ""} | {n: campaigns[0].units[n] for n in names}
    record = laid_out(signals, np.concatenate(blocks), " and ".join(sorted(schemes)), unit, units)
    return record._replace(data_hash="+".join(c.digest() for c in campaigns))


def columns_apart(campaigns: Sequence[Campaign]) -> list[str]:
    """Columns that only some campaigns have: what is of all of them together knows nothing of these.

    Raises:
        CampaignError: it is a rate or numbers stretches, so that the others would be taken for something else.
    """
    each = [set(c.covariates) for c in campaigns]
    apart = sorted(set.union(*each) - set.intersection(*each))
    for name in apart:
        if name in NUMBERED or name.partition("_")[0] == "rate":
            one = next(c for c in campaigns if name not in c.columns)
            raise CampaignError(f"{one.name}: campaigns fitted together need the same columns; {name} is in only some")
    return apart


def _usual_step(interval: np.ndarray, restart: np.ndarray, output: np.ndarray) -> float:
    """The usual time (s) from one row with an output to the next of its run."""
    step, known = interval[~restart], np.isfinite(output)
    if not known.all():
        time, run, rows = np.cumsum(interval), np.cumsum(restart), np.flatnonzero(known)
        between = np.diff(time[rows])[np.diff(run[rows]) == 0]
        step = between if len(between) else step
    return float(np.median(step))


def _own_step(interval: np.ndarray, restart: np.ndarray, output: np.ndarray) -> float | None:
    """A campaign's sample interval (s); none where its rows have no clock, as the dwells of a test."""
    usual, known = _usual_step(interval, restart, output), np.flatnonzero(np.isfinite(output))
    steps = np.diff(np.cumsum(interval)[known]) / usual
    return usual if len(steps) and np.median(np.abs(steps - np.rint(steps))) < JITTER else None


def _counted_on(runs: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The runs of several campaigns, counted on from one to the next where two share a number."""
    numbers = [np.unique(r[np.isfinite(r)]) for r in runs]
    if len(np.unique(np.concatenate(numbers))) == sum(map(len, numbers)):
        return list(runs)
    counted, last = [], 0.0
    for run, own in zip(runs, numbers, strict=True):
        counted.append(run + (last + 1.0 - own[0] if len(own) and counted else 0.0))
        last = float(np.nanmax(counted[-1], initial=last))
    return counted


def _check_alike(campaigns: Sequence[Campaign]) -> None:
    """Refuse campaigns that are not of one unit, recorded alike, each given once."""
    first, said, seen = campaigns[0], dict[str, object](), set[str]()
    for campaign in campaigns if len(campaigns) > 1 else ():
        metadata = {"rate_frame": "table"} | dict(campaign.metadata)
        for key in ("kind", "serial", "rate_frame"):
            if key in metadata and (before := said.setdefault(key, metadata[key])) != metadata[key]:
                raise CampaignError(
                    f"{campaign.name}: campaigns fitted together need the same {key}, but it is {metadata[key]} after "
                    f"{before}"
                )
        for name in set(first.columns) & set(campaign.columns):
            if not convertible(campaign.units[name], first.units[name]):
                raise CampaignError(
                    f"{campaign.name}: column '{name}' is in [{campaign.units[name]}], but in [{first.units[name]}] in "
                    "the first campaign"
                )
        if (digest := campaign.digest()) in seen:
            raise CampaignError(f"{campaign.name}: the same data were given twice")
        seen.add(digest)


def _time_on(campaign: Campaign, time: np.ndarray) -> np.ndarray:
    """Time since power-on of each row (s): a run behind a gap begins with one, or so long after it as the metadata say.

    One that follows without a gap was not off before.
    """
    runs = campaign.columns.get("run", np.zeros(len(time)))
    step, other = np.diff(time), np.diff(runs) != 0
    # Where each row is a run of its own, each begins with one.
    usual = 0.0 if other.all() else np.median(step[~other])
    begins = np.append(True, other & (step > OFF * usual))
    return time - time[np.flatnonzero(begins)][np.cumsum(begins) - 1] + time_since_power_on(campaign)


def time_since_power_on(campaign: Campaign) -> float:
    """How long (s) before the first sample the gyro was turned on, as the metadata say: a time, or a number of seconds.

    Raises:
        CampaignError: they say something else.
    """
    value = campaign.metadata.get("time_since_power_on", 0.0)
    try:
        number, unit = quantity(str(value))
        return number * (factor(unit, "s") if unit else 1.0)
    except UnitError:
        said = f"{campaign.name}: metadata time_since_power_on is {value!r}, expected a time such as 120 s"
        raise CampaignError(said) from None


def thermometer_rate(record: Record, temperature: np.ndarray) -> np.ndarray:
    """The signal temperature_rate that a record would have with another temperature, one value a row."""
    time, rate = np.asarray(record.signals["time"])[: record.rows], np.empty(record.rows)
    for here in _runs(record):
        rate[here] = derivative_by_stretch(time[here], temperature[here])
    return rate


def smooth_thermometer(record: Record, temperature: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A temperature less its noise, and its rate of change, one value a row.

    A spline, and what the square of the rates explains behind leaks: heat of what turns or holds has a corner wherever
    they change. The rest is its mean where the spline varies less than the readings about it: these may shape it alone.
    """
    rates = [np.asarray(record.signals[n])[: record.rows] for n in RATES if n in record.signals]
    heat = np.sum(np.square(rates), axis=0) if rates else np.zeros(record.rows)
    time = np.asarray(record.signals["time"])[: record.rows]
    smooth, slope = np.empty((2, record.rows))
    for here in _runs(record):
        smooth[here], slope[here] = smooth_by_stretch(time[here], temperature[here], heat[here])
    return smooth, slope


def with_smooth_thermometers(record: Record) -> Record:
    """The record with every thermometer less its noise, and the rate of change of that; see `smooth_thermometer`."""
    signals = dict(record.signals)
    for name in thermometers(signals):
        signals |= laid_under(signals, name, *smooth_thermometer(record, np.asarray(signals[name])[: record.rows]))
    return record._replace(signals=signals)


def laid_under(
    signals: dict[str, Float[Array, " sample"]], name: str, values: np.ndarray, rate: np.ndarray
) -> dict[str, Float[Array, " sample"]]:
    """Values of a thermometer and of its rate of change as the signals that there are of it, padded as these."""
    found = {name: values, f"{name}_rate": rate}
    return {
        k: jnp.asarray(np.pad(v, (0, len(signals[k]) - len(v)), mode="edge")) for k, v in found.items() if k in signals
    }


def _runs(record: Record) -> list[np.ndarray]:
    """The rows of each run."""
    runs = np.cumsum(np.asarray(record.sampling.restart)[: record.rows])
    return [np.flatnonzero(runs == i) for i in np.unique(runs)]


def with_columns_known(record: Record) -> tuple[Record, list[str]]:
    """The record without the rows where a measured column is missing, and a sentence for each such column.

    A column missing in more than a fifth of the rows is left as it is: it costs more than it can tell. So is one that
    would cost more than half of them, together with those missing less often.
    """
    signals, said, present = dict(record.signals), [], record.present
    missing = {n: bad for n, v in signals.items() if n != "output" and (bad := ~np.isfinite(np.asarray(v))).any()}
    for name, bad in sorted(missing.items(), key=lambda item: int((item[1][: record.rows] & present).sum())):
        lost = int((bad[: record.rows] & present).sum())
        less = record.without(np.flatnonzero(bad[: record.rows]))
        if lost > MOST_MISSING * present.sum() or less.present.sum() < (1.0 - MOST_LEFT_OUT) * present.sum():
            continue
        record = less
        if lost and name in record.units:
            said.append(f"{lost} rows without {name} were left out.")
    for name, bad in missing.items():
        # Rows that are left out still need a finite value, which then has no weight.
        if not (bad[: record.rows] & record.present).any() and not bad.all():
            signals[name] = jnp.asarray(_filled(np.array(signals[name]), bad, name in NUMBERED))
    return record._replace(signals=signals), said


def _filled(values: np.ndarray, bad: np.ndarray, numbers: bool) -> np.ndarray:
    """Values with those that are bad between their neighbours, or, of numbers of stretches, the nearest one's."""
    row, known = np.arange(len(values)), np.flatnonzero(~bad)
    at = np.interp(row[bad], known, np.arange(len(known)))
    good = values[known]
    values[bad] = good[np.rint(at).astype(int)] if numbers else np.interp(at, np.arange(len(known)), good)
    return values


def laid_out(
    columns: dict[str, np.ndarray], blocks: np.ndarray, scheme: str, unit: str, units: dict[str, str]
) -> Record:
    """A record from its signals, one entry a row, and the unit of its output.

    Beside them `_interval` and `_restart`, and where they are not one and none `_white` and `_start`, are the sampling.
    """
    rows = len(blocks)
    extra = padded_length(rows) - rows
    columns, output = dict(columns), columns["output"]
    interval, restart = columns.pop("_interval"), columns.pop("_restart")
    white, start = columns.pop("_white", np.ones(rows)), columns.pop("_start", np.zeros(rows))
    signals = {n: jnp.asarray(np.pad(v, (0, extra), mode="edge")) for n, v in columns.items()}
    step = _usual_step(interval, restart, output)
    present = np.pad(np.isfinite(output), (0, extra))
    sampling = Sampling(
        jnp.asarray(np.pad(interval, (0, extra))),
        jnp.asarray(np.pad(restart, (0, extra))),
        jnp.asarray(present),
        jnp.asarray(np.pad(white, (0, extra), constant_values=1.0)),
        jnp.asarray(np.pad(start, (0, extra))),
    )
    return Record(signals, sampling, rows, step, unit, units, blocks, scheme)
