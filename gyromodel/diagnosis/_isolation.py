"""How far apart effects lie on a campaign, before or after it is measured, and which further test would part them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq
from scipy.stats import norm

from gyromodel._model_units import parameter_unit
from gyromodel._noise_level import with_stated_level
from gyromodel.campaign import Campaign
from gyromodel.diagnosis._added_tests import added_tests, second_thermometer
from gyromodel.diagnosis._bank import PART_OF, build_bank
from gyromodel.diagnosis._evidence import explained_for, safe_threshold
from gyromodel.diagnosis._forms import step_at
from gyromodel.diagnosis._ranking import skipped
from gyromodel.diagnosis._scan import epochs_of
from gyromodel.effects import CATALOGUE, Effect
from gyromodel.effects._base import evaluate
from gyromodel.estimate import Estimate, as_read, filter_of, given_ratios, step_of, whiten_columns
from gyromodel.model import GyroModel, ModelError, effect_class, make_effect
from gyromodel.noise import NoiseRatios
from gyromodel.signals import Record, read_signals, with_columns_known
from gyromodel.units import factor, internal_unit

# Two signals of one size, this many standard deviations apart, are taken for one another in 5 % of campaigns: Φ(−d/2),
# where they are strong enough for the noise to leave their signs.
MISTAKEN, APART = 0.05, 3.29
# Added to the size that just reaches the threshold, so that noise leaves it there with 80 %.
POWER = 0.84
# Times of a step that stand for all, and the share of a signal that the model must leave.
STEPS, VANISHED = 25, 1e-6
# A test is worth asking for if it brings two effects this many times as far apart; repeating all gives 1.4. More than
# MOST counts no more.
WORTHWHILE, MOST = 1.5, 100.0
# A test that leaves two effects closer than this would have to be done a hundred times.
LEAST = APART / 10.0


class View:
    """A record as noise lets it be seen: signals whitened, in standard deviations, less what a model takes."""

    def __init__(self, record: Record, model: GyroModel, ratios: NoiseRatios, std: float) -> None:
        self.record, self.model, self._std = record, model, std
        self._filter = filter_of(record, ratios)
        self._taken = _basis(self._whitened(np.asarray(model.linearise(record.signals)[1])))

    def _whitened(self, columns: np.ndarray) -> np.ndarray:
        padded = jnp.asarray(np.pad(columns, ((0, 0), (0, -columns.shape[1] % 16))))
        whitened = np.asarray(whiten_columns(self._filter, padded))[: self.record.rows, : columns.shape[1]]
        return whitened[self.record.present] / self._std

    def rest(self, columns: np.ndarray) -> np.ndarray:
        """What is left of columns in output units."""
        whitened = self._whitened(columns)
        return whitened - self._taken @ (self._taken.T @ whitened)

    def columns_of(self, effects: Sequence[Effect], *, whole: bool = False) -> list[np.ndarray]:
        """What is left of the columns of each effect; or all of them."""
        each = list(map(self.model.columns_at(self.record.signals), effects))
        ends = np.cumsum([c.shape[1] for c in each])[:-1]
        columns = np.concatenate(each, axis=1)
        return np.split(self._whitened(columns) if whole else self.rest(columns), ends, axis=1)


def _basis(columns: np.ndarray) -> np.ndarray:
    """Orthonormal columns of the same span."""
    norm = np.linalg.norm(columns, axis=0)
    columns = columns[:, norm > 0] / norm[norm > 0]
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    return u[:, s > 1e-6 * s.max(initial=0.0)]


def _forms(effect: Effect, record: Record) -> list[Effect]:
    """The forms of an effect that a search would try on a record, of steps some; itself if it has no others."""
    if effect.scan == "step":
        return _steps(record) or [effect]
    forms = type(effect).candidates(record.signals) if effect.label == effect.id else []
    return [form for form in forms if not form.grown] or [effect]


def _steps(record: Record) -> list[Effect]:
    """Steps at some epochs, which stand for all; none where samples are too few."""
    epochs = epochs_of(record)[0]
    chosen = epochs[np.linspace(0, len(epochs) - 1, STEPS + 2).astype(int)[1:-1]] if len(epochs) else []
    return [step_at(record, int(row)) for row in chosen]


def nearest(view: View, truths: Sequence[Effect]) -> tuple[float, str, str]:
    """The least distance of one of the effects, as it is, from another of its size, and the names of the two.

    In standard deviations; pairs of which one contains the other are left out.
    """
    found = [(np.inf, "", "")]
    left = [c @ np.asarray(e.linear()) for c, e in zip(view.columns_of(truths), truths, strict=True)]
    for rival in truths:
        bases = [_basis(c) for c in view.columns_of(_forms(rival, view.record))]
        for truth, signal in zip(truths, left, strict=True):
            if truth is rival or truth.label in rival.supersedes or rival.label in truth.supersedes:
                continue
            distance = min(_distance(signal, b) for b in bases)
            found.append((distance, truth.label, rival.label))
    return min(found)


def _distance(signal: np.ndarray, basis: np.ndarray) -> float:
    """Distance of a signal from the nearest one of its size in a span."""
    taken = basis.T @ signal
    sine, own = np.linalg.norm(signal - basis @ taken), np.linalg.norm(signal)
    return float(sine * np.sqrt(2.0 * own / (own + np.linalg.norm(taken)))) if own else 0.0


def settling_test(
    campaigns: Sequence[Campaign], baseline: GyroModel, extended: Estimate, names: Sequence[str]
) -> str | None:
    """The further test that best parts effects which stand for one another, in words; None if none known helps.

    None, too, where they lie far enough apart as it is.

    Args:
        campaigns: what was measured; of a platform none, whose next test is not computed.
        baseline: the simulation.
        extended: the fit with one of the effects.
        names: the effects; gross errors and noise among them are left out, and lines that are none of the fit.
    """
    left_out = {"outliers", *({"bias_periodic"} - {*extended.model.labels})}
    names = [name for name in names if name not in left_out and not name.startswith("noise_")]
    first = next((name for name in names if name in extended.model.labels), None)
    if first is None or len(names) < 2 or not campaigns:
        return None
    without = extended.model.without(first)
    for effect in baseline.effects:
        if effect.label not in (*without.labels, first):
            without = without.with_effect(effect)
    std = float(np.sqrt(extended.white_variance))
    truths = _at_size(View(extended.record, without, extended.ratios, std), extended.model, names)

    def distance(*more: Campaign) -> tuple[float, str, str]:
        record = with_stated_level(with_columns_known(read_signals([*campaigns, *more]))[0], extended.model)
        return nearest(View(record, without, extended.ratios, std), truths)

    now = distance()[0]
    if now >= APART:
        return None  # what leaves them in doubt is nothing that more data of a known kind would settle
    tried = [(*distance(_output_known(test.campaign, 1)), test.sentence) for test in added_tests(campaigns[-1])]
    reached, *closest, sentence = max(tried, key=lambda t: t[0])
    if not reached > max(WORTHWHILE * now, LEAST):
        return None
    again = "" if reached >= APART else f" Do it {int(np.ceil((APART / reached) ** 2))} times."
    return (
        f"{sentence} {' and '.join(sorted(closest))} would then lie {reached:.1f} standard deviations apart instead of "
        f"{now:.1f}; {APART:.1f} tell them apart with 95 %.{again}"
    )


def _at_size(view: View, fitted: GyroModel, names: Sequence[str]) -> list[Effect]:
    """Each effect at the size it has if it is the cause: as fitted, or its form that explains most.

    None that only continues what the view's model already takes whole.
    """
    signals, found = view.record.signals, []
    residual = view.rest(np.asarray(signals["output"] - view.model.predict(signals))[:, None])[:, 0]
    for name in names:
        if name in fitted.labels:
            found.append(fitted.effects[fitted.labels.index(name)])
            continue
        grown = effect_class(name).continuing(view.model.effects, signals)
        if grown is not None:
            column = np.asarray(evaluate(grown, signals)[1][:, -1:]) * float(view.model.gain())
            left = view.rest(column)[:, 0]
            if np.linalg.norm(left) > VANISHED * np.linalg.norm(column):
                last = [k for k, declared in grown.declared().items() if not declared.linear][-1]
                amount = np.clip(left @ residual / (left @ left), -grown.reach, grown.reach)
                found.append(replace(grown, **{last: jnp.asarray(amount)}))
            continue
        tried = []
        forms = _forms(make_effect(name).prepared(signals), view.record)
        for form, columns in zip(forms, view.columns_of(forms), strict=True):
            coefficients, *_ = np.linalg.lstsq(columns, residual, rcond=1e-9)
            tried.append((float(np.sum((residual - columns @ coefficients) ** 2)), form, coefficients))
        _, form, coefficients = min(tried, key=lambda t: t[0])
        found.append(form.with_linear(jnp.asarray(coefficients)))
    return found


def _output_known(campaign: Campaign, number: int = 0) -> Campaign:
    """The campaign with an output at each sample: only that it is there matters, and that no other has the same."""
    name = campaign.outputs[0]
    return campaign.with_column(name, np.arange(len(campaign), dtype=float) + number, campaign.units[name])


class Size(NamedTuple):
    """A size of an effect: of its first parameter, in that parameter's unit."""

    value: float
    unit: str


@dataclass(frozen=True)
class Isolability:
    """What a campaign can show.

    Attributes:
        detectable: least size of each effect that is found with 80 %, were it alone.
        apart: by two effects, the size of the first from which it is told from the second with 95 %; infinite where it
            never is.
        not_testable: effects that the campaign does not show, with the reason.
        tests: further tests, the most helpful first, and a second thermometer where there is one, each with `apart` as
            it is after it, also of effects that the campaign itself does not show, from where they are found.
        std: size of each effect's first parameter that is one standard deviation of the noise, were it alone.
        cosine: by two effects, how much alike they are, whitened and beside the model; 1 where nothing parts them.
    """

    detectable: Mapping[str, Size]
    apart: Mapping[tuple[str, str], Size]
    not_testable: Mapping[str, str]
    tests: tuple[tuple[str, Mapping[tuple[str, str], Size]], ...]
    std: Mapping[str, Size]
    cosine: Mapping[tuple[str, str], float]

    def mistaken(self, effect: str, rival: str, size: float) -> float:
        """The chance that a rival fits better than the effect that is there, each in one form of one coefficient.

        What has more forms fits noise better, and pays for it in a diagnosis.

        Args:
            effect: what is there.
            rival: the other effect.
            size: of the first, in the unit that `std` has.

        Raises:
            KeyError: one of them is not testable, or one is a special case of the other.
        """
        return _mistaken(abs(size) / self.std[effect].value, self.cosine[effect, rival])

    def closest(self, effect: str, apart: Mapping[tuple[str, str], Size] | None = None) -> tuple[str, Size] | None:
        """The effect that is hardest to tell from this one, and the size from which that is done; after a test too."""
        rivals = {b: size for (a, b), size in (self.apart if apart is None else apart).items() if a == effect}
        return max(rivals.items(), key=lambda item: item[1].value) if rivals else None

    def to_dict(self) -> dict[str, Any]:
        """What `gyromodel plan` writes, as plain data; a size that is never reached is null."""

        def plain(size: Size) -> dict[str, Any]:
            return {"size": size.value if np.isfinite(size.value) else None, "unit": size.unit}

        def pairs(sizes: Mapping[tuple[str, str], Size]) -> list[dict[str, Any]]:
            return [{"effect": a, "from": b, **plain(size)} for (a, b), size in sizes.items()]

        return {
            "minimum_detectable": {name: plain(size) for name, size in self.detectable.items()},
            "apart": pairs(self.apart),
            "not_testable": dict(self.not_testable),
            "tests": [{"test": sentence, "apart": pairs(sizes)} for sentence, sizes in self.tests],
        }


def isolability(campaign: Campaign, model: GyroModel, *, tests: bool = True) -> Isolability:
    """Which effects a campaign could show and tell apart, at what size, before any output is measured.

    Args:
        campaign: its columns; the output is not used.
        model: what the simulation contains, with its noise stated.
        tests: whether further tests are tried.

    Raises:
        ModelError: the model states no noise, or a scale factor without a value.
    """
    if not model.noise:
        raise ModelError("what can be told apart depends on the noise: state noise_white and the rest in the model")
    if not np.isfinite(float(model.gain())):
        raise ModelError("what can be told apart depends on the scale factor: state its value in the model")
    campaign = _output_known(campaign)
    now = _sizes([campaign], model)
    # Pairs that are not told apart at the size that shows them are what a further test is for.
    in_doubt = [(a, b) for (a, b), size in now.apart.items() if size.value > now.detectable[a].value]
    runs = [([campaign, _output_known(t.campaign, 1)], t.sentence) for t in added_tests(campaign) if tests]
    runs += [([t.campaign], t.sentence) for t in second_thermometer(campaign) if tests]
    helped = []
    for measured, sentence in runs:
        after = _sizes(measured, model)
        gained = sum(_nats(now.apart[pair], after.apart[pair]) for pair in in_doubt if pair in after.apart)
        known = {*now.detectable, *CATALOGUE}  # not what follows a column that is made up
        apart = {(a, b): size for (a, b), size in after.apart.items() if {a, b} <= known}
        # What the campaign did not show would have had another's name; told apart is only what is found.
        new = {a for a, _ in apart} - {*now.detectable}
        apart |= {(a, b): max(size, after.detectable[a]) for (a, b), size in apart.items() if a in new}
        closest = [after.closest(name, apart) for name in new]
        gained += sum(_nats(Size(np.inf, rival[1].unit), rival[1]) for rival in closest if rival)
        helped.append((gained, sentence, apart))
    helped.sort(key=lambda item: -item[0])
    return replace(now, tests=tuple((sentence, after) for _, sentence, after in helped))


def _nats(before: Size, after: Size) -> float:
    """What a test gains for a pair; of one that was never told apart, as much as counts."""
    return float(np.log(min(before.value / after.value, MOST))) if np.isfinite(after.value) else 0.0


def _mistaken(size: float, cosine: float) -> float:
    """The chance that of two unit signals the one that is there fits worse: that its part of the data is the smaller.

    Their parts differ by d in standard deviations and add up to s, independent of one another, and the larger is the
    one whose difference and sum have one sign: Φ(−d/2) where the size leaves no doubt of the signs.
    """
    if cosine >= 1.0:
        return 0.5
    differ, add = size * np.sqrt((1.0 - cosine) / 2.0), size * np.sqrt((1.0 + cosine) / 2.0)
    return float(norm.cdf(-differ) * norm.cdf(add) + norm.cdf(differ) * norm.cdf(-add))


def _told_from(cosine: float) -> float:
    """The size (standard deviations) from which an effect is told from one so much alike with 95 %; or infinite."""
    each = float(np.sqrt(2.0 * max(1.0 - cosine, 0.0)))
    if each <= VANISHED:
        return np.inf
    root: Any = brentq(lambda size: _mistaken(size, cosine) - MISTAKEN, 0.0, 2.0 * APART / each)
    return float(root)


def _sizes(campaigns: Sequence[Campaign], model: GyroModel) -> Isolability:
    """What some campaigns can show, without further tests."""
    record = with_stated_level(with_columns_known(read_signals(campaigns))[0], model)
    model = model.prepared(record.signals)
    model = as_read(model, record, step_of(model, record))
    ratios = given_ratios(record, model)
    assert ratios is not None
    std = float(model.noise["noise_white"]) / np.sqrt(record.interval) * abs(float(model.gain()))
    view, bank, have = View(record, model, ratios, std), build_bank(record, model), skipped(model, record.signals)
    forms: dict[str, list[Effect]] = {}
    for block in bank.blocks:
        if block.effect is not None and block.name not in have:
            forms.setdefault(block.name, []).append(block.effect)
    if "bias_step" in bank.scans and (steps := _steps(record)):
        forms["bias_step"] = steps
    left = {name: view.columns_of(effects) for name, effects in forms.items()}
    whole = {name: view.columns_of(effects, whole=True) for name, effects in forms.items()}
    not_testable = {name.removeprefix(PART_OF): reason for name, reason in bank.not_testable.items()}
    if "bias_step" in bank.scans and "bias_step" not in forms:
        not_testable["bias_step"] = "too few samples: no size of it would be told"
    untested = [n for n, reason in not_testable.items() if n in CATALOGUE and reason == CATALOGUE[n].untested]
    for name in [n for n in untested if CATALOGUE[n].continuing(model.effects, record.signals) is not None]:
        not_testable[name] = "continues an effect of the model, at sizes that only data show: it is not sized before"
    for name in list(left):
        pairs = zip(left[name], whole[name], strict=True)
        if all(np.linalg.norm(rest) <= VANISHED * np.linalg.norm(own) for rest, own in pairs):
            not_testable[name] = "cannot be told from what the model already has on this campaign"
            del left[name]
    bases = {name: [_basis(c) for c in columns] for name, columns in left.items()}
    per_unit = {name: _per_unit(forms[name], columns) for name, columns in left.items()}
    nu = int(record.present.sum()) - len(model.slots())

    def size(name: str, distance: float) -> Size:
        effect = forms[name][0]
        unit = parameter_unit(effect, effect.leading(), record.output_unit, record.units)
        if effect.site == "gain":
            return Size(distance / per_unit[name] / float(model.gain()) / factor("ppm", "1"), "ppm")
        return Size(distance / per_unit[name] * factor(internal_unit(unit), unit), unit)

    detectable, std = {}, {name: size(name, 1.0) for name in left}
    for name, columns in left.items():
        price = np.log(len(columns)) + bank.price(name)
        needed = explained_for(safe_threshold(nu) + price, nu, columns[0].shape[1])
        detectable[name] = size(name, float(np.sqrt(needed)) + POWER)
    apart, cosine = {}, {}
    for a, b in itertools.permutations(left, 2):
        if a in forms[b][0].supersedes or b in forms[a][0].supersedes:
            continue
        alike = np.median([max(_cosine(x, y) for y in bases[b]) for x in bases[a]])
        cosine[a, b] = min(float(alike), 1.0)
        apart[a, b] = size(a, _told_from(cosine[a, b]))
    return Isolability(detectable, apart, not_testable, (), std, cosine)


def _per_unit(effects: Sequence[Effect], columns: Sequence[np.ndarray]) -> float:
    """Distance that a unit of an effect's first parameter makes, in the median of the forms where it makes any."""
    counts = [jnp.size(getattr(e, e.leading())) for e in effects]
    reach = [np.linalg.norm(c[:, :n], axis=0).max(initial=0.0) for c, n in zip(columns, counts, strict=True)]
    return float(np.median([r for r in reach if r > VANISHED * max(reach)]))


def _cosine(a: np.ndarray, b: np.ndarray) -> float:
    """Of the smallest principal angle between two spans."""
    return float(np.linalg.norm(a.T @ b, 2)) if a.size and b.size else 0.0
