"""The campaigns of an archive: what a folder, a pattern, a Zarr group or a Parquet manifest names."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from gyromodel._checks import CampaignError
from gyromodel.files import SUFFIXES, is_zarr


class Entry(NamedTuple):
    """One campaign of an archive: its name in the results, and where it is."""

    campaign: str
    path: str

    @property
    def state(self) -> str:
        """Size and time of change, by which a campaign that was written anew is known; empty where there is none."""
        try:
            files = [Path(self.path)]
            if files[0].is_dir():
                files = [Path(folder, name) for folder, _, names in os.walk(files[0]) for name in names]
            stats = [file.stat() for file in files]
        except OSError:
            return ""
        return f"{sum(s.st_size for s in stats)}-{max((s.st_mtime_ns for s in stats), default=0)}"


def entries(archive: str, but: Path | None = None) -> list[Entry]:
    """The campaigns of an archive, sorted by name; those of a manifest in its order.

    Args:
        archive: a folder, searched with all below it but what is hidden; a pattern such as `2024/*/rate_*.csv.gz`, with
            `**` for folders of any depth; a Zarr group that holds campaigns as groups; a Parquet file with a column
            `campaign` of paths, relative to it; or a single campaign.
        but: a file that is left out, such as the results.

    Raises:
        CampaignError: there is no such archive, or no campaign in it.
    """
    root = Path(archive)
    if root.is_dir() and not is_zarr(root):
        found = _named(_campaigns_below(root), root)
    elif root.is_dir():
        groups = _groups_below(root)
        found = _named(groups, root) if groups != [root] else [Entry(root.name, str(root.resolve()))]
    elif root.is_file() and root.name.lower().endswith(".parquet") and (listed := _manifest(root)) is not None:
        found = [Entry(name, str((root.parent / name).resolve())) for name in listed]
    elif root.is_file():
        found = [Entry(root.name, str(root.resolve()))]
    else:
        found = sorted(Entry(name, str(Path(name).resolve())) for name in glob.glob(archive, recursive=True))
        if not found and not glob.has_magic(archive):
            raise CampaignError(f"{archive}: there is no such folder or file")
    if but is not None:
        found = [entry for entry in found if Path(entry.path) != but.resolve()]
    if not found:
        raise CampaignError(f"{archive}: there is no campaign in it (looked for names ending in {', '.join(SUFFIXES)})")
    names = [entry.campaign for entry in found]
    if twice := next((name for name in names if names.count(name) > 1), None) if len({*names}) < len(names) else None:
        raise CampaignError(f"{archive}: names {twice} twice")
    return found


def _named(paths: Iterable[Path], root: Path) -> list[Entry]:
    return sorted(Entry(path.relative_to(root).as_posix(), str(path.resolve())) for path in paths)


def _campaigns_below(root: Path) -> list[Path]:
    found = []
    for folder, folders, names in os.walk(root):
        here = Path(folder)
        groups = [name for name in folders if is_zarr(here / name)]
        found += [path for name in groups for path in _groups_below(here / name)]
        folders[:] = [name for name in folders if not name.startswith(".") and name not in groups]
        found += [here / name for name in names if name.lower().endswith(SUFFIXES) and not name.startswith(".")]
    return found


def _groups_below(root: Path) -> list[Path]:
    """The Zarr groups that hold no further ones."""
    below = [path for path in root.iterdir() if path.is_dir() and is_zarr(path)]
    groups = [path for path in below if not _is_array(path)]
    return [leaf for path in groups for leaf in _groups_below(path)] or [root]


def _is_array(path: Path) -> bool:
    if (path / ".zarray").exists():
        return True
    meta = path / "zarr.json"
    return meta.exists() and '"node_type": "array"' in meta.read_text(encoding="utf-8", errors="replace")


def _manifest(path: Path) -> list[str] | None:
    """The column `campaign` of a Parquet file, if it has one of texts."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        schema = parquet.read_schema(path)
    except (pa.ArrowException, OSError) as error:
        raise CampaignError(f"{path}: is no Parquet file, or is damaged") from error
    if "campaign" not in schema.names or not pa.types.is_string(schema.field("campaign").type):
        return None
    return [str(name) for name in parquet.read_table(path, columns=["campaign"])["campaign"].to_pylist()]
