"""Every notebook runs from an empty folder, is short, and is committed with what it printed and drew.

Expected: no error, the rules of length and size below, and an output stored wherever running the notebook gives one.
"""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
FEWEST_TOO_MANY_CELLS, LARGEST = 15, 400_000
TIMEOUT = 300  # s a cell, on a busy machine


@pytest.mark.long
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs_and_is_committed_with_its_outputs(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert path.stat().st_size < LARGEST
    committed = nbformat.read(path, as_version=4)
    nbformat.validate(committed)
    assert len(committed.cells) < FEWEST_TOO_MANY_CELLS
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.delenv("MPLBACKEND", raising=False)  # so that figures are drawn into the notebook
    run = nbformat.read(path, as_version=4)
    NotebookClient(run, timeout=TIMEOUT, resources={"metadata": {"path": str(tmp_path)}}).execute()
    for old, new in zip(committed.cells, run.cells, strict=True):
        if old.cell_type == "code":
            kinds = [{output.output_type for output in cell.outputs} for cell in (old, new)]
            assert kinds[0] == kinds[1], old.source
    assert not list(tmp_path.iterdir())


def test_there_are_notebooks() -> None:
    assert NOTEBOOKS
