"""Campaigns as CSV text, and the headers and metadata texts that Parquet files share with it.

The text is checked block by block, so that a file that is no campaign is refused before it is read to its end.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from gyromodel._checks import CampaignError, check_time, check_unit, shown
from gyromodel.campaign import Campaign

Contents = tuple[dict[str, np.ndarray], dict[str, str], dict[str, Any]]

_BLOCK = 8 << 20
_LONGEST_LINE = 1 << 20
_LONGEST_HEAD = 16 << 20
_HEADER = re.compile(r"(.*?)\s*\[([^\[\]]*)\]", re.DOTALL)
_INTEGER = re.compile(r"[-+]?(?:0|[1-9][0-9]*)")
_DECIMAL = re.compile(r"[-+]?(?:(?:0|[1-9][0-9]*)(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
_FIELD = re.compile(r"[-+]?(?:(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|inf|infinity)", re.IGNORECASE)
# Metadata that name a unit or a day.
NAMES = ("serial", "date")
_MISSING = ("", "nan", "NaN", "NAN", "-nan", "NA", "N/A", "null", "NULL")


def read_csv(stream: io.BufferedIOBase) -> Contents:
    """Columns, units and metadata of a CSV text.

    Raises:
        CampaignError: the text is no campaign; the message names the line, or the data row and column.
    """
    metadata, units, parts = read_csv_parts(stream)
    blocks = list(parts)
    if not blocks:
        raise CampaignError("there is a header and no row of data")
    columns = {name: np.concatenate([block[i] for block in blocks]) for i, name in enumerate(units)}
    return columns, units, metadata


def read_csv_parts(stream: io.BufferedIOBase) -> tuple[dict[str, Any], dict[str, str], Iterator[list[np.ndarray]]]:
    """Metadata and units of a CSV text, and its columns some MiB after others, in order."""
    metadata, units = _read_csv_head(stream)

    def parts() -> Iterator[list[np.ndarray]]:
        names, row, previous = list(units), 1, None
        time = names.index("time")
        for block in _line_blocks(stream):
            values = _parse_block(block, names, row)
            if len(values[time]):
                check_time(values[time], row, previous)
                row, previous = row + len(values[time]), float(values[time][-1])
                yield values

    return metadata, units, parts()


def _read_csv_head(stream: io.BufferedIOBase) -> tuple[dict[str, Any], dict[str, str]]:
    """Metadata lines `# key: value`, comments `# text`, and the header line."""
    metadata: dict[str, Any] = {}
    size = number = 0
    while line := stream.readline(_LONGEST_HEAD):
        number, size = number + 1, size + len(line)
        if size >= _LONGEST_HEAD:
            raise CampaignError(f"the header does not end within {_LONGEST_HEAD >> 20} MiB: this is no CSV text")
        try:
            text = line.decode("utf-8-sig" if number == 1 else "utf-8").strip()
        except UnicodeDecodeError as error:
            raise CampaignError(f"line {number} is not UTF-8 text: {line[error.start :][:8]!r}") from error
        if not text.startswith("#"):
            if text:
                return metadata, read_headers(_split(text, number))
            continue
        key, colon, value = text[1:].partition(":")
        if not colon:
            continue
        if (key := key.strip()) in metadata:
            raise CampaignError(f"metadata {shown(key)} is given twice, the second time in line {number}")
        metadata[key] = metadata_value(key, value.strip())
    raise CampaignError("the file is empty" if not size else "there is no header line 'time [s],...'")


def _split(text: str, number: int) -> list[str]:
    try:
        fields = next(csv.reader([text], strict=True))
    except (csv.Error, StopIteration) as error:
        raise CampaignError(f"line {number} is no CSV header ({error})") from error
    if len(fields) == 1 and (";" in text or "\t" in text):
        raise CampaignError(f"line {number} has no comma: columns are separated by commas")
    if all(_FIELD.fullmatch(field.strip()) for field in fields):
        raise CampaignError(f"line {number} holds numbers where the header 'time [s],...' is expected")
    return fields


def _line_blocks(stream: io.BufferedIOBase) -> Iterator[bytes]:
    """Whole lines, some MiB at a time, or the whole block where a line is longer than that."""
    rest = b""
    while data := stream.read(_BLOCK):
        rest += data
        end = rest.rfind(b"\n") + 1 or (len(rest) if len(rest) > _LONGEST_LINE else 0)
        block, rest = rest[:end], rest[end:]
        if block and not block.isspace():
            yield block
    if rest and not rest.isspace():
        yield rest


def _parse_block(block: bytes, names: list[str], first_row: int) -> list[np.ndarray]:
    """The columns of some lines of numbers."""
    import pyarrow as pa
    from pyarrow import csv as arrow_csv

    if len(block) > _LONGEST_LINE and b"\n" not in block[:_LONGEST_LINE]:
        raise CampaignError(f"data row {first_row} is longer than {_LONGEST_LINE >> 20} MiB: this is no CSV text")
    numbers = [str(i) for i in range(len(names))]
    try:
        table = arrow_csv.read_csv(
            io.BytesIO(block),
            read_options=arrow_csv.ReadOptions(column_names=numbers),
            parse_options=arrow_csv.ParseOptions(quote_char=False),
            convert_options=arrow_csv.ConvertOptions(
                column_types=dict.fromkeys(numbers, pa.float64()), null_values=list(_MISSING)
            ),
        )
    except pa.ArrowInvalid:
        # Quoted numbers, and every fault: Arrow does not say in which row.
        return _parse_lines(block, names, first_row)
    return [column.to_numpy() for column in table.columns]


def _parse_lines(block: bytes, names: list[str], first_row: int) -> list[np.ndarray]:
    """The same as `_parse_block`, slowly, with the place of the first fault."""
    lines = [line for line in re.split(rb"\r\n|\n|\r", block) if line.strip()]
    values = np.empty((len(names), len(lines)))
    for i, line in enumerate(lines):
        row = first_row + i
        try:
            fields = next(csv.reader([line.decode("utf-8", errors="backslashreplace")]))
        except csv.Error as error:
            raise CampaignError(f"data row {row} is no CSV line ({error})") from error
        if len(fields) != len(names):
            raise CampaignError(f"data row {row} has {len(fields)} fields and the header has {len(names)}")
        for j, text in enumerate(field.strip() for field in fields):
            if text not in _MISSING and not _FIELD.fullmatch(text):
                raise CampaignError(f"column '{names[j]}' is {shown(text)} at data row {row}, expected a number")
            values[j, i] = math.nan if text in _MISSING else float(text)
    return list(values)


def write_csv(campaign: Campaign, stream: io.BufferedIOBase) -> None:
    """Write a campaign as CSV text."""
    stream.write(csv_head(campaign))
    write_csv_rows(campaign, stream)


def csv_head(campaign: Campaign) -> bytes:
    """Metadata lines and the header."""
    head = [f"# {key}: {to_text(value)}" for key, value in campaign.metadata.items()]
    return "\n".join([*head, ",".join(write_headers(campaign)), ""]).encode()


def write_csv_rows(campaign: Campaign, stream: Any) -> None:
    """The rows as text."""
    import pyarrow as pa
    from pyarrow import csv as arrow_csv

    table = pa.table([pa.array(values) for values in campaign.columns.values()], names=write_headers(campaign))
    # Arrow writes the shortest digits that read back as the same number.
    arrow_csv.write_csv(table, stream, arrow_csv.WriteOptions(include_header=False))


def read_headers(fields: list[str]) -> dict[str, str]:
    """Unit by column name from headers `name [unit]`, in order."""
    units: dict[str, str] = {}
    for number, header in enumerate(fields, 1):
        match = _HEADER.fullmatch(header.strip())
        name = (match[1] if match else header).strip()
        if not name:
            raise CampaignError(f"column {number} has no name in the header")
        if name in units:
            raise CampaignError(f"two columns are named '{name}': column {list(units).index(name) + 1} and {number}")
        units[name] = check_unit(name, match[2] if match else None)
    if "time" not in units:
        raise CampaignError(f"there is no column 'time [s]': found {shown(', '.join(units))}")
    return units


def to_text(value: str | int | float) -> str:
    """A metadata value as text that `from_text` reads back as the same type."""
    if not isinstance(value, str):
        return repr(value)
    plain = value == value.strip() and value and not re.search(r"[\x00-\x1f]", value) and from_text(value) == value
    return value if plain else json.dumps(value, ensure_ascii=False)


def metadata_value(key: str, text: str) -> str | int | float:
    """The value of a metadata text; what names a unit or a day is no number that would be written otherwise."""
    value = from_text(text)
    return text if key in NAMES and not isinstance(value, str) and str(value) != text else value


def from_text(text: str) -> str | int | float:
    """A number where the text is one, the contents of a quoted text, or the text."""
    if _INTEGER.fullmatch(text) and len(text) < 21 and abs(int(text)) < 2**63:
        return int(text)
    if _DECIMAL.fullmatch(text) and not _INTEGER.fullmatch(text) and math.isfinite(float(text)):
        return float(text)
    if len(text) > 1 and text[0] == text[-1] == '"':
        try:
            return str(json.loads(text))
        except ValueError:
            return text
    return text


def write_headers(campaign: Campaign) -> list[str]:
    """Headers `name [unit]`, in order."""
    return [f"{name} [{campaign.units[name]}]" for name in campaign.columns]
