"""A saved memory, opened, changed and vouched for again, as somebody would who means it."""

import hashlib
import json

import numpy as np
from safetensors.numpy import load, save

from lerobot_openspm.memory.io import ENTRIES, SEAL, arrays_file
from lerobot_openspm.memory.stored_entries import BETWEEN, DIGEST_BYTES, TAIL


def names(directory):
    """Names of the memory's files."""
    return ["memory.json", arrays_file(directory)]


def parts(directory):
    """The header's fields, and the text of the entries with the end of the file."""
    head, _, entries = (directory / "memory.json").read_bytes().partition(ENTRIES)
    return json.loads(head.rpartition(SEAL)[0] + b"}"), entries


def write_parts(directory, header, entries):
    body = json.dumps(header, indent=1).encode().removesuffix(b"\n}")
    seal = SEAL + hashlib.sha256(body).hexdigest().encode()
    (directory / "memory.json").write_bytes(body + seal + ENTRIES + entries)


def edit_header(directory, change):
    header, entries = parts(directory)
    change(header)
    write_parts(directory, header, entries)


def edit_arrays(directory, change):
    arrays = load((directory / arrays_file(directory)).read_bytes())
    change(arrays)
    vouch_for(directory, save(arrays))


def vouch_for(directory, blob):
    """Put a blob in the place of the arrays."""
    (directory / arrays_file(directory)).unlink()
    name = f"memory-{hashlib.sha256(blob).hexdigest()}.safetensors"
    (directory / name).write_bytes(blob)
    edit_header(directory, lambda header: header.update(arrays=name))


def edit_entries(directory, change):
    """Change the list of the entries' fields."""
    rows = json.loads((directory / "memory.json").read_bytes())["entries"]
    change(rows)
    write_texts(directory, [json.dumps(row).encode() for row in rows])


def write_texts(directory, texts):
    """Put texts in the place of the entries, each on its line."""
    header, _ = parts(directory)
    write_parts(directory, header, BETWEEN.join(texts) + TAIL)
    ends = np.cumsum([len(text) + len(BETWEEN) for text in texts]) - len(BETWEEN)
    digests = [hashlib.blake2b(text, digest_size=DIGEST_BYTES).digest() for text in texts]

    def change(arrays):
        n_more = len(texts) - len(arrays["entries.keys"])
        arrays |= {
            "entries.ends": ends.astype(np.int64),
            "entries.digests": np.frombuffer(b"".join(digests), np.uint8).reshape(-1, DIGEST_BYTES),
            "entries.keys": np.pad(arrays["entries.keys"][: len(texts)], (0, max(0, n_more))),
            "entries.qualities": np.array([_quality(text) for text in texts], float),
        }

    edit_arrays(directory, change)


def _quality(text):
    """What a text says of the quality, as far as it can be read."""
    try:
        return float(json.loads(text)["quality"])
    except (TypeError, ValueError, KeyError, RecursionError, OverflowError):
        return 0.0
