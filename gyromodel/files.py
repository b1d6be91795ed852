"""Campaigns to and from files: CSV, gzipped CSV, Parquet, NetCDF-4 and Zarr, all holding the same thing.

Reading checks a CSV file block by block, so that a file that is no campaign is refused before it is read to its end.
Writing goes to a sibling that replaces the target when it is complete.
"""

from __future__ import annotations

import gzip
import math
import mmap
import os
import re
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from gyromodel._atomic import replace_folder, sibling
from gyromodel._checks import CampaignError, check_unit, legible, shown
from gyromodel._csv import (
    Contents,
    metadata_value,
    read_csv,
    read_csv_parts,
    read_headers,
    to_text,
    write_csv,
    write_headers,
)
from gyromodel.campaign import Campaign

# Orders the variables of a NetCDF or Zarr file, which keep no order of their own.
_POSITION = "column"
# Times as CF counts them, from a date, in units that it spells out.
_CF_TIME = re.compile(r"(\w+) since .+")
_CF_UNITS = {"milliseconds": "ms", "microseconds": "us", "nanoseconds": "ns"}
_ZARR_FILES = ("zarr.json", ".zgroup")
# Attributes that HDF5 notes for itself.
_RESERVED = ("CLASS", "DIMENSION_LIST", "NAME", "REFERENCE_LIST")


def read_campaign(path: str | os.PathLike[str], *, measured: bool = True) -> Campaign:
    """Read a campaign; the suffix says how: .csv, .csv.gz, .parquet, .nc or .zarr.

    Args:
        path: the file, or for Zarr the folder.
        measured: whether an output is needed; an output that is missing or the same throughout is a count of rows else.

    Raises:
        CampaignError: the file cannot be read or its contents fail a check; one sentence names the file and the place.
    """
    path = Path(path)
    try:
        suffix = _suffix(path)
        if not path.exists():
            raise CampaignError("there is no such file")
        if path.is_dir() != (suffix == ".zarr"):
            raise CampaignError(
                f"a {suffix} campaign is a {'folder' if suffix == '.zarr' else 'file'}, and this is none"
            )
        columns, units, metadata = _READERS[suffix](path)
        if not measured:
            columns, units, metadata = _with_any_output(columns, units, metadata)
        name = path.name[: -len(suffix)] if path.name.lower().endswith(suffix) else path.name
        return Campaign(columns, units, metadata, legible(name))
    except CampaignError as error:
        raise CampaignError(f"{path}: {error}") from error
    except OSError as error:
        raise CampaignError(f"{path}: cannot be read: {error.strerror or error}") from error


def write_campaign(campaign: Campaign, path: str | os.PathLike[str]) -> None:
    """Write a campaign so that `read_campaign` gives back the same one, bit for bit.

    Args:
        campaign: what to write.
        path: the target, replaced when it exists; its suffix says how to write.

    Raises:
        CampaignError: the suffix is unknown, that kind of file cannot hold a metadata key, or the target cannot be
            written.
    """
    path = Path(path)
    try:
        suffix = _suffix(path)
        if suffix == ".nc" and (kept := next((key for key in campaign.metadata if key in _RESERVED), None)):
            raise CampaignError(f"metadata '{kept}' has a name that NetCDF-4 keeps for itself: rename it")
    except CampaignError as error:
        raise CampaignError(f"{path}: {error}") from error
    with replacing(path) as temporary:
        _WRITERS[suffix](campaign, temporary)


def is_zarr(path: Path) -> bool:
    """Whether a folder is a Zarr group or array."""
    return any((path / name).exists() for name in (*_ZARR_FILES, ".zarray"))


def _with_any_output(columns: Mapping[str, Any], units: Mapping[str, str], metadata: Mapping[str, Any]) -> Contents:
    """Contents of a campaign whose output is of no interest: one, a rate, where there is none or it says nothing."""
    outputs = [name for name in columns if re.fullmatch("output(_[xyz])?", name)] or ["output"]
    known = [values[np.isfinite(values)] for values in (np.asarray(columns.get(name, ()), float) for name in outputs)]
    if any(name.startswith("gimbal_") for name in columns) or any(np.unique(values).size > 1 for values in known):
        return {**columns}, {**units}, {**metadata}
    counted = dict.fromkeys(outputs, np.arange(len(columns.get("time", ())), dtype=float))
    return {**columns, **counted}, {**dict.fromkeys(outputs, "deg/s"), **units}, {"kind": "rate", **metadata}


def _suffix(path: Path) -> str:
    for suffix in _READERS:
        if path.name.lower().endswith(suffix) and len(path.name) > len(suffix):
            return suffix
    if is_zarr(path):
        return ".zarr"
    raise CampaignError(f"the name does not say what the file is: expected a name ending in {', '.join(_READERS)}")


@contextmanager
def replacing(target: Path) -> Iterator[Path]:
    """A hidden sibling that takes the place of a campaign at the end, or goes away after an error.

    Raises:
        CampaignError: a folder of something else is there, or it cannot be written.
    """
    path = Path(os.path.realpath(target))
    try:
        if path.is_dir() and not (_suffix(path) == ".zarr" and any((path / name).exists() for name in _ZARR_FILES)):
            raise CampaignError(f"{target}: is a folder that holds something else than a campaign")
        with sibling(path) as temporary:
            yield temporary
            if path.is_dir():
                replace_folder(temporary, path)
            else:
                os.replace(temporary, path)
    except OSError as error:
        raise CampaignError(f"{target}: cannot be written: {error.strerror or error}") from error


@contextmanager
def _damage(form: str) -> Iterator[None]:
    """Turn whatever a library raises on a damaged file into one sentence."""
    try:
        yield
    except CampaignError:
        raise
    except Exception as error:  # HDF5, Zarr and Arrow raise nearly every type when bytes are wrong
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise CampaignError(f"is no {form} file, or is cut short or damaged ({reason[:200]})") from error


def _read_csv(path: Path) -> Contents:
    with open(path, "rb") as stream:
        return read_csv(stream)


def _read_csv_gz(path: Path) -> Contents:
    try:
        with gzip.open(path, "rb") as stream:
            return read_csv(stream)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise CampaignError(f"is no gzip file, or is cut short or damaged ({error})") from error


def _write_csv(campaign: Campaign, path: Path) -> None:
    with open(path, "xb") as stream:
        write_csv(campaign, stream)


def _write_csv_gz(campaign: Campaign, path: Path) -> None:
    # Neither name nor time inside, so that the same campaign gives the same bytes.
    with open(path, "xb") as file, gzip.GzipFile("", "wb", 4, file, mtime=0) as stream:
        write_csv(campaign, stream)


def _read_parquet(path: Path) -> Contents:
    import pyarrow as pa
    from pyarrow import parquet

    with _damage("Parquet"), parquet.ParquetFile(path, page_checksum_verification=True) as file:
        units, metadata = _parquet_head(file.schema_arrow)
        table = file.read()
        columns = {
            name: column.cast(pa.float64(), safe=False).to_numpy()
            for name, column in zip(units, table.columns, strict=True)
        }
    return columns, units, metadata


def _parquet_head(schema: Any) -> tuple[dict[str, str], dict[str, Any]]:
    """Units and metadata of a Parquet file."""
    import pyarrow as pa

    units = read_headers(schema.names)
    for name, kind in zip(units, schema.types, strict=True):
        if not any(test(kind) for test in (pa.types.is_floating, pa.types.is_integer, pa.types.is_decimal)):
            raise CampaignError(f"column '{name}' holds {kind}, expected numbers")
    texts = {key.decode(): value.decode() for key, value in (schema.metadata or {}).items()}
    # What pandas and Arrow note for themselves is not about the gyro.
    return units, {
        key: metadata_value(key, text) for key, text in texts.items() if key not in ("pandas", "ARROW:schema")
    }


@contextmanager
def reading_parts(path: Path) -> Iterator[tuple[dict[str, str], dict[str, Any], Iterator[list[np.ndarray]]] | None]:
    """Units, metadata, and the columns of some rows after others, of a kind of file that can be read so; else None."""
    suffix = _suffix(path)
    if suffix == ".parquet":
        import pyarrow as pa
        from pyarrow import parquet

        # What is fetched ahead would be kept to the end.
        with parquet.ParquetFile(path, page_checksum_verification=True, pre_buffer=False) as file:
            parts = (
                [column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False) for column in batch.columns]
                for batch in file.iter_batches(1 << 16)
            )
            yield *_parquet_head(file.schema_arrow), parts
    elif suffix in (".csv", ".csv.gz"):
        with open(path, "rb") if suffix == ".csv" else gzip.open(path, "rb") as stream:
            metadata, units, parts = read_csv_parts(stream)
            yield units, metadata, parts
    else:
        yield None


def read_metadata(path: Path) -> Mapping[str, Any]:
    """The metadata of a campaign file without its samples; may raise what `read_campaign` turns into one sentence."""
    suffix = _suffix(path)
    if suffix == ".zarr":
        import zarr

        return zarr.open_group(path, mode="r").attrs
    if suffix == ".nc":
        return _netcdf_metadata(path)
    with reading_parts(path) as opened:
        assert opened is not None
        return opened[1]


def _write_parquet(campaign: Campaign, path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    metadata = {key: to_text(value) for key, value in campaign.metadata.items()}
    arrays = [pa.array(values) for values in campaign.columns.values()]
    table = pa.table(arrays, names=write_headers(campaign)).replace_schema_metadata(metadata)
    parquet.write_table(table, path, compression="zstd", write_page_checksum=True)


def _netcdf_metadata(path: Path) -> dict[str, Any]:
    import h5py

    with h5py.File(path, "r") as file:
        _check_heaps(path)
        return dict(file.attrs)


def _read_netcdf(path: Path) -> Contents:
    with _damage("NetCDF-4"):
        _netcdf_metadata(path)  # h5netcdf prints a traceback where these are damaged, h5py raises
        return _read_dataset(path, engine="h5netcdf")


def _check_heaps(path: Path) -> None:
    """Walk the blocks of texts in an HDF5 file, because the HDF5 library never returns when a length in one is wrong.

    Source: HDF5 File Format Specification, III.E, disk format of the global heap.
    """
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        start = -1
        while (start := data.find(b"GCOL\x01\0\0\0", start + 1)) >= 0:
            end = start + int.from_bytes(data[start + 8 : start + 16], "little")
            index, at = 1, start + 16
            while index and at + 16 <= end:
                index, length = (
                    int.from_bytes(data[at : at + 2], "little"),
                    int.from_bytes(data[at + 8 : at + 16], "little"),
                )
                # Object 0 is the free space, its header counted; the others have theirs besides, padded to 8 bytes.
                at += 16 + -(-length // 8) * 8 if index else length
            if end > len(data) or at > end or (index == 0 and at != end):
                raise CampaignError("is damaged: a block of texts in it does not add up")


def _read_zarr(path: Path) -> Contents:
    import zarr

    with _damage("Zarr"):
        for folder in path.iterdir():
            if folder.is_dir() and not (folder.name.startswith(".") or is_zarr(folder)):
                raise CampaignError(f"column {shown(folder.name)} lacks its description: the copy is not complete")
        for name, array in zarr.open_group(path, mode="r").arrays():
            # Before a value is read: codecs of objects may run what is in the file.
            if array.dtype.kind not in "iuf":
                raise CampaignError(f"column '{name}' holds {array.dtype}, expected numbers")
            # Zarr reads a chunk that is not there as fill values, which would pass for missing samples. Writers leave
            # out whole numbers that are all zero, as those of runs may be.
            missing = array.nchunks - array.nchunks_initialized
            if missing and (array.dtype.kind == "f" or re.match("time|output", name)):
                raise CampaignError(
                    f"column '{name}' lacks {missing} of {array.nchunks} chunks: the copy is not complete"
                )
        return _read_dataset(path, engine="zarr", consolidated=False)


def _read_dataset(path: Path, **options: Any) -> Contents:
    import xarray as xr

    columns: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    with xr.open_dataset(path, decode_times=False, decode_coords=False, **options) as dataset:
        metadata = {str(key): _plain(value) for key, value in dataset.attrs.items()}
        variables = {str(name): variable for name, variable in dataset.variables.items()}
        for name in sorted(variables, key=lambda name: _position(variables[name].attrs)):
            variable = variables[name]
            if variable.dims != ("time",):
                raise CampaignError(f"variable {shown(name)} has dimensions {variable.dims}, expected ('time',)")
            if variable.dtype.kind not in "iuf":
                raise CampaignError(f"column '{name}' holds {variable.dtype}, expected numbers")
            unit = variable.attrs.get("units")
            since = _CF_TIME.fullmatch(str(unit)) if name == "time" else None
            unit = _CF_UNITS.get(since[1], since[1]) if since else unit
            units[name] = check_unit(name, None if unit is None else str(unit))
            columns[name] = np.asarray(variable.values, dtype=np.float64)
    return columns, units, metadata


def _position(attributes: Mapping[str, Any]) -> float:
    position = attributes.get(_POSITION)
    return float(position) if isinstance(position, int | float | np.number) else math.inf


def _plain(value: Any) -> str | int | float:
    """An attribute as text or number; an array of several values as text."""
    value = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    return value if isinstance(value, str | int | float) and not isinstance(value, bool) else str(value)


def _dataset(campaign: Campaign) -> Any:
    import xarray as xr

    variables = {
        name: ("time", values, {"units": campaign.units[name] or "1", _POSITION: position})
        for position, (name, values) in enumerate(campaign.columns.items())
    }
    return xr.Dataset(variables, attrs=dict(campaign.metadata))


def _write_netcdf(campaign: Campaign, path: Path) -> None:
    # The checksum lets a reader see a flipped bit.
    chunk = {
        "zlib": True,
        "complevel": 4,
        "shuffle": True,
        "fletcher32": True,
        "chunksizes": (min(len(campaign), 1 << 16),),
    }
    encoding = dict.fromkeys(campaign.columns, chunk)
    # HDF5 ends the process where a disk is full: it writes to memory, and Python to the disk.
    with open(path, "xb") as file:
        file.write(_dataset(campaign).to_netcdf(engine="h5netcdf", encoding=encoding))


def _write_zarr(campaign: Campaign, path: Path) -> None:
    from zarr.codecs import ZstdCodec

    chunk = {"compressors": [ZstdCodec(level=3, checksum=True)], "chunks": (min(len(campaign), 1 << 16),)}
    encoding = dict.fromkeys(campaign.columns, chunk)
    _dataset(campaign).to_zarr(path, mode="w", encoding=encoding, consolidated=False, write_empty_chunks=True)


_READERS: dict[str, Callable[[Path], Contents]] = {
    ".csv": _read_csv,
    ".csv.gz": _read_csv_gz,
    ".parquet": _read_parquet,
    ".nc": _read_netcdf,
    ".zarr": _read_zarr,
}
_WRITERS: dict[str, Callable[[Campaign, Path], None]] = {
    ".csv": _write_csv,
    ".csv.gz": _write_csv_gz,
    ".parquet": _write_parquet,
    ".nc": _write_netcdf,
    ".zarr": _write_zarr,
}
# What the name of a campaign ends in.
SUFFIXES = tuple(_READERS)
