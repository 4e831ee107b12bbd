"""Rows of files, one at a time and within limits: a file that somebody else made must not fill the memory.

Lines of JSON, a list in a .json file, tables (.csv, .parquet, .arrow), each .gz or not where it is text. No code and no
pickle is ever read from a file.
"""

from __future__ import annotations

import csv
import gzip
import json
import math
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

ROW_LIMIT = 16 << 20
"""Bytes in one row."""
UNPACKED_FREELY = 64 << 20
UNPACKED_RATIO = 200
"""How many times its size a .gz may unpack to, once it has given `UNPACKED_FREELY` bytes; text gives 3 to 20."""
CHUNK = 1 << 16
TABLES = (".csv", ".parquet", ".arrow")
ARCHIVES = (".zip", ".tar", ".tgz", ".7z", ".rar")


@dataclass(frozen=True)
class Line:
    """A line of JSON that is not parsed yet."""

    text: str


def read_rows(path: Path) -> Iterator[Any]:
    """The rows of a file in their order: a `Line`, a dict of a table's row, or an element of a list.

    Raises `ValueError` for what cannot be read on from: a damaged or overgrown .gz, a row over 16 MB, a broken table.
    """
    suffixes = [s.lower() for s in path.suffixes if s.lower() != ".gz"]
    kind = suffixes[-1] if suffixes else ""
    if kind in ARCHIVES or path.suffixes[-2:] == [".tar", ".gz"]:
        raise ValueError(f"{path}: archives are not opened; unpack it, and give the file or the folder")
    if kind == ".parquet":
        return _parquet(path)
    if kind == ".arrow":
        return _arrow(path)
    if kind == ".csv":
        return _csv(path)
    return _list(path) if kind == ".json" and _first_character(path) == "[" else map(Line, read_lines(path))


def parse_json(text: str) -> Any:
    """A JSON value without NaN, infinities and numbers that overflow to them."""
    try:
        return json.loads(text, parse_constant=_no_constant, parse_float=_finite)
    except RecursionError:
        raise ValueError("the object is nested too deeply") from None


def read_lines(path: Path, ends: bool = False) -> Iterator[str]:
    """The lines of a UTF-8 file (.gz or not), cut at line feeds alone; `ends` keeps what ends them."""
    with _opened(path) as source:
        number = 0
        # One byte more than is allowed: a row that is too long shows without being read to its end.
        while line := source.file.readline(ROW_LIMIT + 1):
            number += 1
            if len(line) > ROW_LIMIT:
                raise ValueError(f"{path}: row {number} is longer than {ROW_LIMIT >> 20} MB, the most a row may have")
            source.check(len(line))
            try:
                # A byte order mark stands at the start alone; anywhere else it is text.
                text = line.decode("utf-8-sig" if number == 1 else "utf-8")
            except UnicodeDecodeError as error:
                raise ValueError(f"{path}: row {number} is no UTF-8 text ({error.reason}); convert the file") from None
            yield text if ends else text.rstrip("\r\n")


@dataclass
class _Source:
    """An open file, and how far it has been read."""

    path: Path
    raw: IO[bytes]
    file: IO[bytes]
    read: int = 0

    def check(self, count: int) -> None:
        """Note `count` bytes more. Raises `ValueError` where far more come out than went in."""
        self.read += count
        # Against how much of the packed file was read so far, not its size: the bomb may be in the middle.
        if self.read > UNPACKED_FREELY and self.read > UNPACKED_RATIO * max(self.raw.tell(), 1):
            raise ValueError(
                f"{self.path} unpacks to over {UNPACKED_RATIO} times its size: it is refused; unpack it yourself if "
                "you trust it"
            )


@contextmanager
def _opened(path: Path) -> Iterator[_Source]:
    try:
        with path.open("rb") as raw:
            if path.suffix.lower() != ".gz":
                yield _Source(path, raw, raw)
                return
            with gzip.GzipFile(fileobj=raw) as file:
                yield _Source(path, raw, file)  # type: ignore[arg-type]
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise ValueError(f"{path} is no whole gzip file: {error}") from error


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not a value")


def _finite(text: str) -> float:
    if not math.isfinite(value := float(text)):
        raise ValueError(f"{text:.40} is too large for a number")
    return value


# --- one JSON list ------------------------------------------------------------------------------------------------


def _first_character(path: Path) -> str:
    with _opened(path) as source:
        return source.file.read(64).decode("utf-8-sig", "ignore").lstrip()[:1]


@dataclass
class _Text:
    """The text of a file that waits to be parsed, from `at` on."""

    chunks: Iterator[str]
    text: str = ""
    at: int = 0

    def more(self, least: int = 1) -> bool:
        """Have at least so many characters more; false at the end of the file."""
        parts, count = [self.text[self.at :]], 0
        while count < least and (part := next(self.chunks, "")):
            parts.append(part)
            count += len(part)
        self.text, self.at = "".join(parts), 0
        return count > 0

    def peek(self) -> str:
        """The next character that is no space; "" at the end of the file."""
        while True:
            while self.at < len(self.text) and self.text[self.at] in " \t\r\n":
                self.at += 1
            if self.at < len(self.text) or not self.more():
                return self.text[self.at : self.at + 1]


def _chunks(path: Path) -> Iterator[str]:
    import codecs

    decoder = codecs.getincrementaldecoder("utf-8-sig")()
    with _opened(path) as source:
        while chunk := source.file.read(CHUNK):
            source.check(len(chunk))
            if text := decoder.decode(chunk):
                yield text
        decoder.decode(b"", True)


def _list(path: Path) -> Iterator[Any]:
    """The elements of a file that is one JSON list, without having all of it in memory."""
    decoder = json.JSONDecoder(parse_constant=_no_constant, parse_float=_finite)
    text, number, expected = _Text(_chunks(path)), 0, "["
    while True:
        try:
            found = text.peek()
            text.at += 1
            if found == "]":
                break
            if found != expected:
                raise ValueError(f"expected {expected!r}, got {found!r}")
            expected = ","
            if text.peek() == "]" and not number:
                text.at += 1
                break
            number += 1
            element = _element(text, decoder)
        except ValueError as error:
            raise ValueError(f"{path}: row {number}: {error}") from None
        yield element
    if rest := text.peek():
        raise ValueError(f"{path}: expected nothing after the list, got {rest!r}")


def _element(text: _Text, decoder: json.JSONDecoder) -> Any:
    """The next element; more text is fetched, twice as much each time, until it is whole."""
    least = CHUNK
    while True:
        try:
            value, end = decoder.raw_decode(text.text, text.at)
            if end < len(text.text) or not text.more():  # a number may go on in the next chunk
                text.at = end if end < len(text.text) else len(text.text)
                return value
        except RecursionError:
            raise ValueError("the object is nested too deeply") from None
        except json.JSONDecodeError as error:
            if len(text.text) - text.at > ROW_LIMIT or not text.more(least):
                raise ValueError(f"{error.msg}, or a row of more than {ROW_LIMIT >> 20} MB") from None
            least *= 2  # so that an element is parsed anew only a few times, however long it is


# --- tables -------------------------------------------------------------------------------------------------------


def _csv(path: Path) -> Iterator[dict[str, str | None]]:
    """Rows of a .csv with a header; a cell without anything in it is None."""
    csv.field_size_limit(ROW_LIMIT)
    table, number = csv.reader(read_lines(path, ends=True), strict=True), 0
    try:
        header = next(table, [])
        if not header or len(set(header)) < len(header):
            raise ValueError(f"expected a header that names each column once, got {', '.join(header) or 'nothing'}")
        for cells in table:
            number += bool(cells)
            if cells and len(cells) != len(header):
                raise ValueError(f"row {number}: expected {len(header)} cells, as the header has, got {len(cells)}")
            if cells:
                yield {name: cell or None for name, cell in zip(header, cells, strict=True)}
    except csv.Error as error:
        raise ValueError(f"{path}: row {number + 1}: {error}") from None
    except ValueError as error:
        raise ValueError(str(error) if str(error).startswith(f"{path}") else f"{path}: {error}") from None


def _parquet(path: Path) -> Iterator[Any]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path) as table:
            for batch in table.iter_batches(batch_size=64):
                yield from _small(path, batch)
    except pa.ArrowException as error:
        raise ValueError(f"{path} cannot be read as Parquet: {error}") from None


def _arrow(path: Path) -> Iterator[Any]:
    import pyarrow as pa

    try:
        with pa.memory_map(str(path)) as file, pa.ipc.open_stream(file) as stream:
            for batch in stream:
                yield from _small(path, batch)
    except pa.ArrowException as error:
        raise ValueError(f"{path} cannot be read as Arrow: {error}") from None


def _small(path: Path, batch: Any) -> Iterator[Any]:
    for start in range(0, batch.num_rows, 64):
        some = batch.slice(start, 64)
        if some.nbytes > 64 * ROW_LIMIT:  # before to_pylist, whose objects take many times as much
            raise ValueError(f"{path}: rows of more than {ROW_LIMIT >> 20} MB, the most a row may have")
        yield from some.to_pylist()


def list_files(folder: Path, patterns: Sequence[str]) -> list[Path]:
    """The files of a folder that match one of the patterns, sorted. Raises `ValueError` for symbolic links in it."""
    found = [path for pattern in patterns for path in folder.rglob(pattern)]
    refuse_links(folder)
    return sorted(path for path in set(found) if path.is_file())


def refuse_links(folder: Path) -> None:
    """Raise `ValueError` where a folder holds a symbolic link: it could lead anywhere."""
    for path in folder.rglob("*"):
        if path.is_symlink():
            raise ValueError(f"{path} is a symbolic link: it is refused, since it could lead anywhere")
