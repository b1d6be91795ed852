"""The campaigns of an archive: what a folder, a pattern, a Zarr group or a Parquet manifest names."""

from __future__ import annotations

import glob
import json
import os
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from gyromodel._checks import CampaignError, legible
from gyromodel.files import SUFFIXES, is_zarr, read_metadata

# Metadata of campaigns that commands have computed columns for: copies, and no measurements.
COMPUTED = ("rate_estimated_std_holds", "navigated")
# What an exported calibration begins with.
EXPORTED = b"effect,kind,name,"


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
            `campaign` of paths, relative to it; or a single campaign. A link to what the archive has anyway, such as
            one named `latest`, is no further campaign.
        but: a file that is left out, such as the results.

    Raises:
        CampaignError: there is no such archive, or no campaign in it.
    """
    root = Path(archive)
    if root.is_dir() and not is_zarr(root):
        found = _measured(_named(_campaigns_below(root), root))
    elif root.is_dir():
        groups = _groups_below(root)
        found = _measured(_named(groups, root)) if groups != [root] else [Entry(root.name, str(root.resolve()))]
    elif root.is_file() and root.name.lower().endswith(".parquet") and (listed := _manifest(root)) is not None:
        found = [Entry(name, str((root.parent / name).resolve())) for name in listed]
    elif root.is_file():
        found = [Entry(root.name, str(root.resolve()))]
    else:
        found = _measured(_each_once(_campaigns_among(_matching(root))))
        if not found and not glob.has_magic(archive):
            raise CampaignError(f"{archive}: there is no such folder or file")
    if but is not None:
        found = [entry for entry in found if Path(entry.path) != but.resolve()]
    if not found:
        raise CampaignError(f"{archive}: there is no campaign in it (looked for names ending in {', '.join(SUFFIXES)})")
    found = [entry._replace(campaign=legible(entry.campaign)) for entry in found]
    times = Counter(entry.path for entry in found)
    if twice := next((entry.campaign for entry in found if times[entry.path] > 1), None):
        raise CampaignError(f"{archive}: names {twice} twice")
    return found


def _named(paths: Iterable[Path], root: Path) -> list[Entry]:
    return [Entry(Path(name).relative_to(root).as_posix(), path) for name, path in _each_once(paths)]


def _measured(found: Iterable[Entry]) -> list[Entry]:
    """Without what commands have written; a damaged file stays, as its row will say what is wrong with it."""
    return [entry for entry in found if not _is_result(Path(entry.path))]


def _is_result(path: Path) -> bool:
    name = path.name.lower()
    with suppress(Exception):
        if name.endswith(".parquet") and _manifest(path) is not None:
            return True
        if name.endswith(".csv"):
            with open(path, "rb") as file:
                if file.read(len(EXPORTED)) == EXPORTED:
                    return True
        return not read_metadata(path).keys().isdisjoint(COMPUTED)
    return False


def _each_once(paths: Iterable[Path]) -> list[Entry]:
    """Sorted by name; what several names lead to has that without a link, else the one of the fewest folders."""
    found: dict[str, tuple[bool, int, str]] = {}
    for path in paths:
        real = os.path.realpath(path)
        name = os.path.abspath(path) != real, len(path.parts), str(path)
        found[real] = min(name, found.get(real, name))
    return sorted(Entry(name, real) for real, (_, _, name) in found.items())


def _campaigns_among(paths: Iterable[Path]) -> Iterator[Path]:
    """Files, and Zarr groups that hold no further ones in place of their parts."""
    for path in paths:
        if is_zarr(path):
            yield from _groups_below(path) if _is_group(path) or not is_zarr(path.parent) else ()
        elif not path.is_dir() and not any(map(is_zarr, path.parents)):
            yield path


def _matching(pattern: Path) -> list[Path]:
    """What a pattern names: as `glob` does, which never ends where links below `**` lead round in circles."""
    if "**" not in pattern.parts:
        return [Path(name) for name in glob.glob(str(pattern))]
    place = pattern.parts.index("**")
    tops, rest = _matching(Path(*pattern.parts[:place])), pattern.parts[place + 1 :] or ("*",)
    folders = [folder for top in tops for folder, _, _ in _walked(top)]
    found = [path for folder in folders for path in _matching(Path(glob.escape(folder), *rest))]
    return found


def _walked(root: Path) -> Iterator[tuple[str, list[str], list[str]]]:
    """As `os.walk` through links, but no hidden folders, and each link to what is not below anyway once."""
    top, seen = os.path.realpath(root), set[str]()
    for folder, folders, names in os.walk(root, followlinks=True):
        folders[:] = [name for name in sorted(folders) if not name.startswith(".")]
        links = {name: os.path.realpath(path) for name in folders if (path := Path(folder, name)).is_symlink()}
        folders[:] = [n for n in folders if n not in links or not (links[n] in seen or _nested(top, links[n]))]
        seen |= {*links.values()}
        yield folder, folders, names


def _campaigns_below(root: Path) -> list[Path]:
    found = []
    for folder, folders, names in _walked(root):
        here = Path(folder)
        groups = [name for name in folders if is_zarr(here / name)]
        found += [path for name in groups for path in _groups_below(here / name)]
        folders[:] = [name for name in folders if name not in groups]
        found += [here / name for name in names if name.lower().endswith(SUFFIXES) and not name.startswith(".")]
    return found


def _nested(one: str, other: str) -> bool:
    """Whether a folder lies in the other: a link from it to there leads to nothing new, or round in circles."""
    return os.path.commonpath([one, other]) in (one, other)


def _groups_below(root: Path) -> list[Path]:
    """The Zarr groups that hold no further ones."""
    groups = [path for path in root.iterdir() if path.is_dir() and _is_group(path)]
    return [leaf for path in groups for leaf in _groups_below(path)] or [root]


def _is_group(path: Path) -> bool:
    """Whether a folder says that it is one: what is damaged is a part of the group that it is in."""
    if (path / ".zgroup").exists():
        return True
    with suppress(OSError, ValueError, TypeError, KeyError, RecursionError):
        return json.loads((path / "zarr.json").read_bytes())["node_type"] == "group"
    return False


def _manifest(path: Path) -> list[str] | None:
    """The column `campaign` of a Parquet file, if it has one of texts."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        schema = parquet.read_schema(path)
    except (pa.ArrowException, OSError) as error:
        raise CampaignError(f"{path}: is no Parquet file, or is damaged") from error
    kind = schema.field("campaign").type if "campaign" in schema.names else pa.null()
    kind = kind.value_type if isinstance(kind, pa.DictionaryType) else kind
    if kind not in (pa.string(), pa.large_string(), pa.string_view()):
        return None
    names = parquet.read_table(path, columns=["campaign"])["campaign"].to_pylist()
    if not all(names):
        raise CampaignError(f"{path}: row {next(i for i, name in enumerate(names, 1) if not name)} names no campaign")
    return names
