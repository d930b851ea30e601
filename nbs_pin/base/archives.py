"""Archives of named entries, written atomically and verified byte by byte when read.

The file is an uncompressed zip archive, so any zip tool can open it. The entry `manifest.json` states the format and
the size and SHA-256 of every other entry. The archive comment, the last 64 bytes of the file, is the SHA-256 of
everything before it, which also covers the manifest and the zip headers. These checksums detect damage and hand edits;
they do not authenticate the author.
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
"""Name of the entry that lists the others with their checksums."""
DEEPEST = 64
"""Most levels of lists and objects in JSON; what handles them deeper overflows the stack."""
_CHECKSUM = 64
_DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, ValueError, EOFError, NotImplementedError, RuntimeError)


def write_archive(path: str | Path, file_format: str, entries: Mapping[str, bytes]) -> None:
    """Write the entries to `path` atomically: an interruption leaves either the old file or the new one.

    Equal entries give equal bytes.
    """
    manifest = {"format": file_format, "entries": {name: _digest(content) for name, content in entries.items()}}
    body = _zipped({MANIFEST: json.dumps(manifest, indent=1).encode(), **entries})
    write_whole(path, body + _hash(body))


def read_archive(path: str | Path, file_format: str) -> dict[str, bytes]:
    """The entries of a file written by `write_archive`.

    Raises:
        FileNotFoundError: If the file does not exist.
        FileFormatError: If it is larger than `npz.LARGEST`, has another format, or was changed in any byte.
    """
    size = Path(path).stat().st_size
    if size > LARGEST:
        raise FileFormatError(f"{path}: has {size} bytes, at most {LARGEST} are read; give a '{file_format}' file.")
    content = Path(path).read_bytes()
    entries = _unzipped(path, content, file_format)
    manifest = parse_json(path, MANIFEST, entries.pop(MANIFEST, b"{}"))
    if "format" not in manifest:
        raise FileFormatError(f"{path}: no '{file_format}' file; give one that this package wrote.")
    if manifest["format"] != file_format:
        raise FileFormatError(
            f"{path}: the format is {manifest['format']!r}, expected '{file_format}'; write it with this version."
        )
    listed, found = manifest.get("entries"), {name: _digest(entry) for name, entry in entries.items()}
    stated = listed if isinstance(listed, dict) else {}
    for name in sorted(stated.keys() | found.keys()):
        if stated.get(name) != found.get(name):
            raise FileFormatError(f"{path}: '{name}' does not match its recorded SHA-256 or size; take an older copy.")
    if _hash(content[:-_CHECKSUM]) != content[-_CHECKSUM:]:
        raise FileFormatError(f"{path}: was changed after it was written (checksum mismatch); take an older copy.")
    return entries


def parse_json(path: str | Path, name: str, content: str | bytes) -> dict[str, Any]:
    """The JSON object in the entry `name`.

    Raises:
        FileFormatError: If it is not a JSON object, repeats a key or holds a number that is not finite.
    """
    try:
        value = json.loads(content, object_pairs_hook=_unique, parse_constant=_finite, parse_float=_finite)
        if _depth(value) > DEEPEST:
            raise ValueError(f"more than {DEEPEST} levels deep")
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{path}: '{name}' cannot be read as JSON ({error}); write the file again.") from error
    if not isinstance(value, dict):
        raise FileFormatError(
            f"{path}: '{name}' is a {type(value).__name__}, expected an object; write the file again."
        )
    return value


def _zipped(entries: Mapping[str, bytes]) -> bytes:
    """The bytes of the archive up to its comment."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        archive.comment = bytes(_CHECKSUM)
        for name, content in entries.items():
            info = zipfile.ZipInfo(name)  # dated 1980, so that equal entries give equal files
            info.create_system, info.external_attr = 3, 0o644 << 16
            archive.writestr(info, content)
    return buffer.getvalue()[:-_CHECKSUM]


def _unzipped(path: str | Path, content: bytes, file_format: str) -> dict[str, bytes]:
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = archive.infolist()
            stored = all(info.compress_type == zipfile.ZIP_STORED for info in infos)
            if not stored or sum(info.file_size for info in infos) > len(content):
                raise ValueError("entries are compressed or larger than the file")
            entries = {info.filename: archive.read(info) for info in infos}
            if len(entries) < len(infos):
                raise ValueError("several entries have the same name")
            return entries
    except _DAMAGE as error:
        fault = str(error) or "truncated"
        raise FileFormatError(f"{path}: not an intact '{file_format}' file ({fault}); take an older copy.") from error


def _digest(content: bytes) -> dict[str, Any]:
    return {"size": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def _hash(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode()


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(dict(pairs)) < len(pairs):
        raise ValueError(f"repeated key among {', '.join(key for key, _ in pairs)}")
    return dict(pairs)


def _depth(value: Any) -> int:
    """How many lists and objects enclose the innermost value."""
    level, depth = [value], 0
    while level:
        inner = [list(x.values()) if isinstance(x, dict) else x for x in level if isinstance(x, dict | list)]
        depth += bool(inner)
        level = [x for values in inner for x in values]
    return depth


def _finite(number: str) -> float:
    value = float(number)
    if value - value != 0.0:
        raise ValueError(f"{number} is not finite")
    return value
