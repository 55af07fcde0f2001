"""The container of binary glTF: its JSON document and its binary chunk."""

import struct
from typing import Any

from ..files import parse_json

MAGIC, VERSION, JSON_KIND = b"glTF", 2, b"JSON"
HEADER_BYTES, CHUNK_HEADER_BYTES = 20, 8
"""The file's header and that of its first chunk; and that of any later chunk."""


def glb_chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The document and the binary chunk of a .glb file; the chunk is empty where there is none.

    Raises ValueError where it is not binary glTF 2.0. Source: Khronos, glTF 2.0, section 4.4.
    """
    if len(data) < HEADER_BYTES:
        raise ValueError("ends within its header")
    magic, version, _, length, kind = struct.unpack_from("<4sIII4s", data)
    if (magic, version, kind) != (MAGIC, VERSION, JSON_KIND):
        raise ValueError("expected binary glTF 2.0, with a JSON chunk at its beginning")
    if length > len(data) - HEADER_BYTES:
        raise ValueError("its JSON chunk reaches beyond the file")
    document = parse_json(data[HEADER_BYTES : HEADER_BYTES + length])
    if not isinstance(document, dict):
        raise ValueError("its JSON chunk holds no object")
    rest = data[HEADER_BYTES + length :]
    size = struct.unpack_from("<I", rest)[0] if len(rest) >= CHUNK_HEADER_BYTES else 0
    return document, rest[CHUNK_HEADER_BYTES : CHUNK_HEADER_BYTES + size]
