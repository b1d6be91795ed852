"""Reference points of an archive: the temperatures, rates and so on that all of its campaigns tell parameters at."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from gyromodel._yaml import exact_text
from gyromodel.batch._archive import Entry
from gyromodel.diagnosis._bank import OWN_EFFECTS
from gyromodel.diagnosis._drivers import driver_names
from gyromodel.effects import CATALOGUE, Effect, Signals
from gyromodel.effects._base import lacking
from gyromodel.effects.drivers import BiasColumn
from gyromodel.estimate import Estimate, read_for_fit
from gyromodel.files import read_campaign
from gyromodel.model import GyroModel
from gyromodel.model_files import SETTING_UNITS, setting_unit
from gyromodel.platform import is_platform
from gyromodel.signals import Record

# Values in internal units, and as texts, by effect and setting, such as bias_temperature.reference.
References = dict[str, tuple[float, str]]
# Steps in which a model at other reference points comes to the same predictions, and how near, relative to their
# standard uncertainty.
STEPS, SAME = 8, 1e-3
# Campaigns in a row without a further reference point, after which no more are read for what a diagnosis may add.
ENOUGH = 32


def open_references(every: Sequence[Entry], model: GyroModel, diagnosing: bool) -> References:
    """Reference points that the model leaves open: each that of the first campaign that has it.

    With its own in each campaign, a bias would be that of another temperature every time.

    Args:
        every: the campaigns.
        model: what they are fitted with.
        diagnosing: whether those of the effects that a diagnosis may add are wanted too.
    """
    unset = {key for effect in model.effects for key, value, _ in _points(effect) if np.isnan(value)}
    known: References = {}
    without = 0
    for entry in every if unset or diagnosing else ():
        if unset <= set(known) and (not diagnosing or without >= ENOUGH):
            break
        try:
            campaign = read_campaign(entry.path)
            if is_platform(campaign):
                continue
            if len(campaign.outputs) > 1:
                campaign = campaign.axis(campaign.outputs[0].removeprefix("output_"))
            record = read_for_fit([campaign])
            effects = [*model.prepared(record.signals).effects]
            effects += [e for e in _addable(record) if diagnosing and e.label not in model.labels]
        except Exception:  # its own row says why
            continue
        found = {
            key: (value, str(exact_text(value, setting_unit(effect, name, record))))
            for effect in effects
            for key, value, name in _points(effect)
            if np.isfinite(value) and (diagnosing or key in unset) and key not in known
        }
        known |= found
        without = 0 if found else without + 1
    return known


def _addable(record: Record) -> Iterator[Effect]:
    """Effects with reference points that a diagnosis of this record may add."""
    for kind in CATALOGUE.values():
        refers = kind is not BiasColumn and not {*SETTING_UNITS}.isdisjoint(kind.settings())
        if refers and not lacking(kind.needs, record.signals):
            yield kind().prepared(record.signals)
    for name in driver_names(record):
        if name not in OWN_EFFECTS:
            yield BiasColumn(column=name).prepared(record.signals)


def _points(effect: Effect) -> Iterator[tuple[str, float, str]]:
    """Reference points of an effect: key, value (internal units) and setting."""
    for name in SETTING_UNITS:
        if hasattr(effect, name):
            yield f"{effect.label}.{name}", float(getattr(effect, name)), name


def with_references(model: GyroModel, references: Mapping[str, tuple[float, str]]) -> GyroModel:
    """The model with these reference points; its parameters keep their values."""
    for i, effect in enumerate(model.effects):
        for key, _, name in _points(effect):
            if key in references:
                value = jnp.asarray(references[key][0])
                model = eqx.tree_at(lambda m, i=i, name=name: getattr(m.effects[i], name), model, value)
    return model


def referred(estimate: Estimate, references: References) -> tuple[GyroModel, np.ndarray, bool]:
    """A fitted model at these reference points, its predictions the same.

    Returns:
        The model, the covariance of its free parameters, and whether all of it is at these points: where no values of
        the parameters make the predictions the same, it stays at the campaign's own (a spline over the rate would have
        its knots elsewhere, say).
    """
    model, covariance, common = estimate.model, estimate.covariance, True
    for effect in estimate.model.effects:
        points = {key: value for key, value, _ in _points(effect)}
        wanted = {key: references[key] for key in points if key in references}
        common &= len(wanted) == len(points)
        if all(points[key] == value for key, (value, _) in wanted.items()):
            continue
        moved = _alike(with_references(model, wanted), model, covariance, estimate.record.signals)
        if moved is None:
            common = False
        else:
            model, covariance = moved
    return model, covariance, common


def _alike(
    other: GyroModel, model: GyroModel, covariance: np.ndarray, signals: Signals
) -> tuple[GyroModel, np.ndarray] | None:
    """The other model with parameters at which it predicts what the model does, and their covariance, if there are."""
    wanted, columns = (np.asarray(x) for x in model.linearise(signals))
    for _ in range(STEPS):
        found, own = (np.asarray(x) for x in other.linearise(signals))
        size = np.linalg.norm(own, axis=0)
        size[size == 0] = 1.0
        step = np.linalg.lstsq(own / size, np.column_stack([wanted - found, columns]), rcond=None)[0] / size[:, None]
        other = other.with_vector(np.asarray(other.vector()) + step[:, 0])
    variance = np.einsum("ij,jk,ik->i", columns, covariance, columns).mean()
    if not np.mean((wanted - np.asarray(other.predict(signals))) ** 2) <= SAME**2 * variance:
        return None
    return other, step[:, 1:] @ covariance @ step[:, 1:].T
