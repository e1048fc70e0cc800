"""A saved memory, opened, changed and vouched for again, as somebody would who means it."""

import hashlib
import json

import numpy as np
from safetensors.numpy import load, save

from lerobot_openspm.memory.bank import DIGEST_BYTES, HEAD, TAIL, Lines
from lerobot_openspm.memory.files import lines_to_arrays, read_header, sealed


def name_of(directory, kind):
    """Name of the file of "entries", "arrays" or "cameras"."""
    return read_header(directory)["files"][kind]["file"]


def names(directory):
    """Names of the memory's files, as its header has them."""
    return ["memory.json", *(name_of(directory, kind) for kind in ("entries", "arrays", "cameras"))]


def edit_header(directory, change):
    path = directory / "memory.json"
    header = json.loads(path.read_text())
    change(header)
    try:
        path.write_text(json.dumps(sealed(header)))
    except ValueError:  # NaN has no canonical form; it is refused before the checksum is looked at
        path.write_text(json.dumps(header))


def edit_arrays(directory, change):
    arrays = load((directory / name_of(directory, "arrays")).read_bytes())
    change(arrays)
    vouch_for(directory, save(arrays))


def vouch_for(directory, blob):
    """Put a blob in the place of the arrays."""
    (directory / name_of(directory, "arrays")).write_bytes(blob)
    sha256 = hashlib.sha256(blob).hexdigest()
    edit_header(directory, lambda header: header["files"]["arrays"].update(sha256=sha256))


def edit_entries(directory, change):
    """Change the list of the entries' fields."""
    path = directory / name_of(directory, "entries")
    rows = json.loads(path.read_text())
    change(rows)
    write_texts(directory, [json.dumps(row).encode() for row in rows])


def write_texts(directory, texts):
    """Put texts in the place of the entries, each on its line."""
    ends, position = [], len(HEAD)
    for text in texts:
        position += len(text) + 2 * bool(ends)
        ends.append(position)
    digests = [hashlib.blake2b(text, digest_size=DIGEST_BYTES).digest() for text in texts]
    lines = Lines(np.array(ends), np.frombuffer(b"".join(digests), np.uint8).reshape(-1, DIGEST_BYTES))
    (directory / name_of(directory, "entries")).write_bytes(HEAD + b",\n".join(texts) + TAIL)
    columns = {
        "entries.keys": np.zeros(len(texts), np.uint64),
        "entries.qualities": np.array([_quality(text) for text in texts], float),
    }
    edit_arrays(directory, lambda arrays: arrays.update(lines_to_arrays(lines) | columns))


def _quality(text):
    """What a text says of the quality, as far as it can be read."""
    try:
        return float(json.loads(text)["quality"])
    except (TypeError, ValueError, KeyError, RecursionError, OverflowError):
        return 0.0
