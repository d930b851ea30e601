"""Named entries in one sealed file: written whole or not at all, read only when every byte is as it was written.

The file is a zip archive in which nothing is compressed, so that any tool can look into it. Its entry `manifest.json`
says the format and holds the size and the SHA-256 of every other entry; its comment, the last 64 bytes of the file, is
the SHA-256 of everything before it, which covers what zip and manifest leave unchecked. The seal tells damage and hand
edits, not who wrote the file.
"""

import hashlib
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nbs_pin.base.exceptions import FileFormatError
from nbs_pin.base.files import write_whole
from nbs_pin.base.npz import LARGEST

MANIFEST = "manifest.json"
"""Name of the entry that lists the others."""
_SEAL = 64
_DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, ValueError, EOFError, NotImplementedError, RuntimeError)


def write_archive(path: str | Path, file_format: str, entries: Mapping[str, bytes]) -> None:
    """Write the entries to `path`; whatever interrupts it, the name holds the old file or the new one, never half.

    The same entries give the same bytes.
    """
    manifest = {"format": file_format, "entries": {name: _digest(content) for name, content in entries.items()}}
    body = _zipped({MANIFEST: json.dumps(manifest, indent=1).encode(), **entries})
    write_whole(path, body + _hash(body))


def read_archive(path: str | Path, file_format: str) -> dict[str, bytes]:
    """The entries of the file that `write_archive` wrote.

    Raises FileNotFoundError for no file, and FileFormatError for one that is larger than `npz.LARGEST`, of another
    format, or changed in any byte.
    """
    size = Path(path).stat().st_size
    if size > LARGEST:
        raise FileFormatError(f"{path}: has {size} bytes, at most {LARGEST} are read; give a '{file_format}' file.")
    content = Path(path).read_bytes()
    entries = _unzipped(path, content, file_format)
    manifest = parse_json(path, MANIFEST, entries.pop(MANIFEST, b"{}"))
    if manifest.get("format") != file_format:
        raise FileFormatError(
            f"{path}: the format is {manifest.get('format')!r}, expected '{file_format}'; write it with this version."
        )
    listed, found = manifest.get("entries"), {name: _digest(entry) for name, entry in entries.items()}
    stated = listed if isinstance(listed, dict) else {}
    for name in sorted(stated.keys() | found.keys()):
        if stated.get(name) != found.get(name):
            raise FileFormatError(f"{path}: '{name}' is not what was written (SHA-256 or size); take an older copy.")
    if _hash(content[:-_SEAL]) != content[-_SEAL:]:
        raise FileFormatError(f"{path}: was changed after it was written (its seal is broken); take an older copy.")
    return entries


def parse_json(path: str | Path, name: str, content: bytes) -> dict[str, Any]:
    """The JSON object in the entry `name`: no key twice, no number that is not finite; else raises FileFormatError."""
    try:
        value = json.loads(content, object_pairs_hook=_unique, parse_constant=_finite, parse_float=_finite)
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{path}: '{name}' is no JSON that we write ({error}); write the file again.") from error
    if not isinstance(value, dict):
        raise FileFormatError(
            f"{path}: '{name}' is a {type(value).__name__}, expected an object; write the file again."
        )
    return value


def _zipped(entries: Mapping[str, bytes]) -> bytes:
    """The archive up to its comment."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        archive.comment = bytes(_SEAL)
        for name, content in entries.items():
            info = zipfile.ZipInfo(name)  # of 1980, so that equal entries are equal files
            info.create_system, info.external_attr = 3, 0o644 << 16
            archive.writestr(info, content)
    return buffer.getvalue()[:-_SEAL]


def _unzipped(path: str | Path, content: bytes, file_format: str) -> dict[str, bytes]:
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = archive.infolist()
            stored = all(info.compress_type == zipfile.ZIP_STORED for info in infos)
            if not stored or sum(info.file_size for info in infos) > len(content):
                raise ValueError("entries that are compressed or larger than the file")
            entries = {info.filename: archive.read(info) for info in infos}
            if len(entries) < len(infos):
                raise ValueError("entries of the same name")
            return entries
    except _DAMAGE as error:
        fault = str(error) or "cut short"
        raise FileFormatError(f"{path}: not an intact '{file_format}' file ({fault}); take an older copy.") from error


def _digest(content: bytes) -> dict[str, Any]:
    return {"size": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def _hash(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode()


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(dict(pairs)) < len(pairs):
        raise ValueError(f"a key twice among {', '.join(key for key, _ in pairs)}")
    return dict(pairs)


def _finite(number: str) -> float:
    value = float(number)
    if value - value != 0.0:
        raise ValueError(f"{number} is not finite")
    return value
