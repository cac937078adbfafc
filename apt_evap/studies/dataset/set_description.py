"""The files of a data set beside those of its examples: ``dataset.json``, which says what it contains, and checksums.

``dataset.json`` names what the set is made from (the keys of the points, the settings, the version) and the SHA-256 of
each file that is complete. It exists from the beginning, so that a folder is known as a data set. ``SHA256SUMS`` is
written at the end: a set without it is not finished.
"""

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from apt_evap._common.codec import from_plain, to_plain
from apt_evap._common.files import FileError, check_path, read_small_file, replace_file, sha256_of
from apt_evap._common.kept import first_difference
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_choice, check_count, short_text
from apt_evap.simulation.config.tables import check_keys, check_table
from apt_evap.studies.dataset.dataset_settings import SPLITS, DatasetSettings
from apt_evap.studies.dataset.datasheet import datasheet
from apt_evap.studies.dataset.fields import chosen_tables
from apt_evap.studies.dataset.shards import Schema, file_names

FORMAT = "apt_evap dataset 2"
ABOUT, SHEET, SUMS = "dataset.json", "README.md", "SHA256SUMS"
"""Files of a data set beside those of its examples."""
COUNTS = ("runs", "examples", "ions")
"""What is counted for each part."""
_TEXTS = ("title", "description", "licence")  # settings that do not change the examples
_KEYS = ("format", "title", "dataset", "points", "study", "versions", "left_out", "counts", "tables", "shards")
_SHARD_KEYS = ("name", "split", "key", "files", *COUNTS, "bytes")
_SHARD = re.compile(rf"({'|'.join(SPLITS)})-[0-9]{{4,9}}")
_DIGEST = re.compile(r"[0-9a-f]{64}")
_MAX_BYTES = 1 << 30
_LARGEST = 1 << 48  # of a number of rows or bytes: sums of them are still integers


def made_from(content: dict[str, Any]) -> dict[str, Any]:
    """What determines the examples of each run of a data set: the settings without its texts, and the version."""
    settings = {name: value for name, value in content["dataset"].items() if name not in _TEXTS}
    return {"dataset": settings, "version": content["versions"]["apt_evap"]}


def counts_of(shards: list[dict[str, Any]]) -> dict[str, dict[str, int]]:
    """Numbers of runs, examples and ions of each part."""
    return {
        split: {name: sum(shard[name] for shard in shards if shard["split"] == split) for name in COUNTS}
        for split in SPLITS
    }


def tables_of(schema: Schema) -> dict[str, list[dict[str, Any]]]:
    """Fields of each table in plain types."""
    return {
        name: [
            {
                "name": field.name,
                "type": field.kind,
                "shape": list(field.row),
                "unit": field.unit,
                "description": field.text,
            }
            for field in fields
        ]
        for name, fields in schema.items()
    }


def write_about(folder: Path, content: dict[str, Any]) -> None:
    """Write ``dataset.json``."""
    _write(folder / ABOUT, json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def finish(folder: Path, content: dict[str, Any]) -> None:
    """Write the description, the data sheet and the checksums of a data set whose files are complete."""
    write_about(folder, content)
    _write(folder / SHEET, datasheet(content))
    sums = {name: digest for shard in content["shards"] for name, digest in shard["files"].items()}
    sums |= {name: sha256_of(folder / name) for name in (ABOUT, SHEET)}
    _write(folder / SUMS, "".join(f"{digest}  {name}\n" for name, digest in sorted(sums.items())))


def _write(path, text):
    with replace_file(path) as file:
        file.write(text.encode())


def read_about(folder: Path) -> dict[str, Any]:
    """Content of ``dataset.json``; FileError if it is not that of a data set."""
    path = folder / ABOUT
    try:
        content = json.loads(read_small_file(path, _MAX_BYTES, "the description of a data set"))
        check_table(content, "its content")
        if content.get("format") != FORMAT:
            raise ValueError(f"format must be {FORMAT!r}, got {short_text(content.get('format'))}")
        check_keys(content, _KEYS, _KEYS)
        settings = from_plain(content["dataset"], DatasetSettings, what="dataset")
        schema = chosen_tables(settings.fields)
        _check_texts(content)
        shards: list[Any] = content["shards"] if isinstance(content["shards"], list) else [None]
        for shard in shards:
            _check_shard(shard, schema, settings.format)
        if len({shard["name"] for shard in shards}) < len(shards):
            raise ValueError("names of shards must be different")
        expected = {"dataset": to_plain(settings), "counts": counts_of(shards), "tables": tables_of(schema)}
        if difference := first_difference({name: content[name] for name in expected}, expected):
            raise ValueError(f"{difference[0]} must be {difference[2]}, got {difference[1]}")
    except FileError:
        raise
    except (ValueError, RecursionError) as error:
        raise FileError(f"{str(path)!r} is not the description of a data set: {error}") from error
    return content


def _check_texts(content):
    """Check the parts that are texts, or texts by name."""
    if not isinstance(content["title"], str):
        raise ValueError(f"title must be a text, got {short_text(content['title'])}")
    points = content["points"]
    if not isinstance(points, list) or not all(isinstance(key, str) for key in points):
        raise ValueError(f"points must be a list of texts, got {short_text(points)}")
    for name in ("study", "versions", "left_out"):
        check_table(content[name], name)
        for key, text in content[name].items():
            if not isinstance(text, str):
                raise ValueError(f"{name}.{key} must be a text, got {short_text(text)}")
    check_keys(content["versions"], tuple(content["versions"]), ("apt_evap",))


def _check_shard(shard, schema, suffix):
    """Check the entry of a shard; its files have the names that follow from its own, so that none leads elsewhere."""
    check_table(shard, "shards")
    check_keys(shard, _SHARD_KEYS, _SHARD_KEYS)
    name = shard["name"]
    match = _SHARD.fullmatch(name) if isinstance(name, str) else None
    if match is None or check_choice(shard["split"], "split", SPLITS) != match[1]:
        raise ValueError(f"names of shards must be such as 'train-0000', with this split, got {short_text(name)}")
    if not isinstance(shard["key"], str):
        raise ValueError(f"key must be a text, got {short_text(shard['key'])}")
    check_table(shard["files"], "files")
    names = set(file_names(name, schema, suffix).values())
    check_keys(shard["files"], tuple(names), tuple(names))
    for file, digest in shard["files"].items():
        if digest is not None and not (isinstance(digest, str) and _DIGEST.fullmatch(digest)):
            raise ValueError(f"files.{file} must be a SHA-256 or null, got {short_text(digest)}")
    for count in (*COUNTS, "bytes"):
        check_count(shard[count], count, at_most=_LARGEST)


def is_complete(shard: dict[str, Any]) -> bool:
    """Whether all files of a shard are written."""
    return None not in shard["files"].values()


def is_finished(folder: Path) -> bool:
    """Whether a folder has the checksums of a finished data set."""
    return (folder / SUMS).exists()


def read_finished(folder: Path, names: Iterable[str] | None = ()) -> dict[str, Any]:
    """Content of ``dataset.json`` of a finished data set, after a comparison with its checksums."""
    content = read_about(folder)
    if not is_finished(folder):
        raise FileError(f"{str(folder)!r} is not a finished data set: it has no {SUMS}")
    text = read_small_file(folder / SUMS, _MAX_BYTES, "checksums").decode(errors="replace")
    sums = {name: digest for digest, _, name in (line.partition("  ") for line in text.splitlines())}
    expected = {name: digest for shard in content["shards"] for name, digest in shard["files"].items()}
    if sums.keys() != {*expected, ABOUT, SHEET}:
        name = min(sums.keys() ^ {*expected, ABOUT, SHEET})
        raise FileError(f"{str(folder / SUMS)!r} must have one checksum of each file of the data set, see {name!r:.80}")
    for name in sorted(sums) if names is None else [ABOUT, *names]:
        check_sha256(folder / name, sums[name], f"that of {SUMS}")
    for name, digest in expected.items():
        if digest != sums[name]:
            raise FileError(f"{str(folder / SUMS)!r} has another checksum of {name} than {ABOUT}")
    return content


def check_sha256(path: Path, digest: str, expected: str) -> None:
    """Compare the SHA-256 of a file; FileError if it is another one."""
    if sha256_of(path) != digest:
        remedy = "remove it, and make the data set again"
        raise FileError(f"{str(path)!r} is damaged: its SHA-256 is not {expected}; {remedy}")


def verify_dataset(folder: AnyPath) -> dict[str, Any]:
    """Verify a finished data set: the checksums of all its files.

    Parameters
    ----------
    folder : str or path-like
        The data set.

    Returns
    -------
    dict
        Content of ``dataset.json``.

    Raises
    ------
    FileError
        If the set is not finished, or a file is missing or damaged.
    """
    return read_finished(check_path(folder), None)
