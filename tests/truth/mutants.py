"""The engine with one of its safeguards off: what each is for must then fail."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np


@contextmanager
def mutated(name: str) -> Iterator[None]:
    """Patch the package: "" leaves it as it is; "forced" adds the best candidate whatever its evidence."""
    with ExitStack() as patches:
        for target, replacement in _patches(name).items():
            patches.enter_context(patch(f"gyromodel.diagnosis.{target}", replacement))
        yield


def _patches(name: str) -> dict[str, Any]:
    if not name:
        return {}
    from gyromodel.diagnosis import _gain, _scan, _session
    from gyromodel.estimate import fit_record

    run_many, grid = _scan.Scanner.run_many, _session.noise_grid

    def white_only(samples: int, interval: float, span: float) -> Any:
        return grid(1, interval, span)

    def nothing_projected(scanner: Any, cells: Any, jacobian: np.ndarray, *rest: Any) -> Any:
        return run_many(scanner, cells, jacobian[:, :0], *rest)

    def best_of_parts(values: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ends = np.append(starts, len(values))[1:]
        rows = np.stack([a + values[a:b].argmax(0) for a, b in zip(starts, ends, strict=True)])
        return np.maximum.reduceat(values, starts, axis=0), rows

    def refitted(
        session: Any, baseline: Any, selection: Any, measured: Any, unit: str, scale: float, ordinary: Any, say: Any
    ) -> Any:
        chosen = selection.estimate

        def select(rows: np.ndarray, base: Any) -> Any:
            return fit_record(session.record.without(rows), chosen.model_as_given(), ratios=chosen.ratios)

        return _gain.nested_gain(session.record, baseline, select, unit, scale, ordinary)

    forced = {"_session.safe_threshold": lambda nu: -1e9, "_search.MAXIMUM_ROUNDS": 1, "_beside.MAXIMUM_ROUNDS": 1}
    return {
        "no_whitening": {"_session.noise_grid": white_only},
        "no_projection": {"_scan.Scanner.run_many": nothing_projected},
        "no_look_elsewhere": {
            "_one_cell.log_mean_of_parts": best_of_parts,
            "_one_cell.log_mean": lambda ratios: ratios.max(axis=0),
        },
        "forced": forced,
        "forced_no_nesting": forced | {"_diagnose.gain_of": refitted},
    }[name]
