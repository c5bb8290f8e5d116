"""Compact scenes, damaged at random: as a file, in what it unpacks to, or in its table."""

import json
import struct
import zlib
from collections.abc import Sequence

from helpers.hostile import ByteEdits, TreeEdits, byte_edits, edit_bytes, edit_tree, json_text, tree_edits
from hypothesis import strategies as st

CompactDamage = tuple[int, str, ByteEdits, TreeEdits]
_TIMING = '{"times": [0.0, 0.5, 1.0], "moments": [0.1, 0.5, 0.9]}'
_WORDS = [b'"shape":[0', b'"F16"', b'"U16"', b'"data_offsets":[0,9007199254740991]', b"lapgs4d\n", b"\xff" * 8]


def damaged_compact_scenes(files: int) -> st.SearchStrategy[CompactDamage]:
    """Damage to one of so many files."""
    places = st.sampled_from(["file", "content", "table", "field", "timing"])
    return st.tuples(st.integers(0, files - 1), places, byte_edits(_WORDS), tree_edits)


def damage_compact(files: Sequence[bytes], damage: CompactDamage) -> bytes:
    """One of the files with its damage; but in the file itself, the sizes of the header stay right."""
    number, place, edits, changes = damage
    data = files[number]
    if place == "file":
        return edit_bytes(data, edits, head=40)
    content = zlib.decompress(data[20:])
    length = int.from_bytes(content[:8], "little")
    table = json.loads(content[8 : 8 + length])
    if place == "content":
        content = edit_bytes(content, edits, head=length)
    else:
        if place in ("field", "timing"):
            texts = table["__metadata__"]
            damaged = edit_tree(json.loads(texts.get(place, _TIMING)), changes)
            texts[place] = json_text(damaged).decode("utf-8", "replace")
            text = json_text(table)
        else:
            text = json_text(edit_tree(table, changes))
        content = len(text).to_bytes(8, "little") + text + content[8 + length :]
    return struct.pack("<8sIQ", data[:8], 1, len(content)) + zlib.compress(content)
