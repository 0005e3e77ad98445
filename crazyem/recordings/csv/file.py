"""Read flights from CSV files (plain or gzip) with a mapping that the user gives or the header determines."""

from collections.abc import Iterator
from pathlib import Path

from crazyem.recordings.contents import ReadOptions
from crazyem.recordings.csv.long import read_long
from crazyem.recordings.csv.mapping import known_mappings, mapping_for
from crazyem.recordings.csv.text import parse_header_line, read_header
from crazyem.recordings.csv.wide import read_wide, read_wide_parts
from crazyem.recordings.recording import Recording


def recognises(head: bytes) -> bool:
    """True if the first line looks like a CSV header: text with at least two names and delimiters."""
    try:
        names, _ = parse_header_line(head.split(b"\n", 1)[0].decode("utf-8-sig"))
    except UnicodeDecodeError:
        return False
    return len(names) > 1 and all(name.isprintable() for name in names)


def has_mapping(path: Path) -> bool:
    """Whether a shipped mapping knows the columns of this file. Raises FileFormatError if it has no readable header."""
    columns = set(read_header(path).names)
    return any(set(mapping.recognise) <= columns for mapping in known_mappings())


def read(path: Path, options: ReadOptions) -> Recording:
    """Read a CSV flight. Raises FileFormatError naming the file and what is wrong with it."""
    header = read_header(path)
    mapping = mapping_for(header.names, options.mapping, path)
    if mapping.layout == "long":
        return read_long(path, header, mapping, options)
    return read_wide(path, header, mapping, as_published=options.as_published)


def read_parts(path: Path, options: ReadOptions, seconds: float = 60.0) -> Iterator[Recording]:
    """Read a CSV flight in parts of about `seconds` each, in bounded memory.

    The joined arrays of a signal, with `order`, equal those of `read`; each part has its own findings. Files in long
    form come in one part. Raises FileFormatError, possibly after some parts.
    """
    header = read_header(path)
    mapping = mapping_for(header.names, options.mapping, path)
    if mapping.layout == "long":
        yield read_long(path, header, mapping, options)
        return
    yield from read_wide_parts(path, header, mapping, as_published=options.as_published, seconds=seconds)
