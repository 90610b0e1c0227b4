"""A check that the elements of a MATLAB 5 file fit into each other, since scipy's reader crashes where they do not.

The layout is that of "MAT-File Format" (The MathWorks), level 5: elements of a type, a size and their bytes, nested.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from math import prod

_HEADER_BYTES = 128
_MATRIX, _COMPRESSED = 14, 15
_CELL, _STRUCT, _CHAR, _NUMERIC = 1, 2, 4, range(6, 16)
_ITEM_BYTES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8, 16: 1, 17: 2, 18: 4}
_COMPLEX = 0x0800
_DEEPEST = 8
Element = tuple[int, memoryview]


def check_elements(content: bytes) -> None:
    """Raise ValueError where an element of the file does not hold what its size and its type promise."""
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if order is None:
        raise ValueError("it does not say its byte order")
    for kind, data in _elements(memoryview(content)[_HEADER_BYTES:], order):
        if kind == _COMPRESSED:
            for inner in _elements(memoryview(zlib.decompress(data)), order):
                _check_matrix(*inner, order)
        else:
            _check_matrix(kind, data, order)


def _elements(data: memoryview, order: str) -> Iterator[Element]:
    while len(data):
        kind, size = _tag(data, order)
        # Of up to four bytes, size and type share a word, and the bytes follow in the next.
        small, start = kind >> 16, 8
        if small:
            kind, size, start = kind & 0xFFFF, small, 4
        if start + size > max(len(data), 8) or (small and small > 4):
            raise ValueError(f"an element of {size} bytes where {len(data) - start} are left")
        yield kind, data[start : start + size]
        # Compressed elements are not padded.
        whole = start + size if kind == _COMPRESSED else -(-(start + size) // 8) * 8
        data = data[whole:]


def _tag(data: memoryview, order: str) -> tuple[int, int]:
    if len(data) < 8:
        raise ValueError("an element is cut off")
    return struct.unpack_from(f"{order}II", data)


def _check_matrix(kind: int, data: memoryview, order: str, depth: int = 0) -> None:
    if kind != _MATRIX or depth > _DEEPEST:
        raise ValueError(f"an element of type {kind}, expected a matrix")
    if not len(data):
        return
    flags, dimensions, _name, *parts = _elements(data, order)
    if (flags[0], len(flags[1])) != (6, 8) or dimensions[0] not in (5, 6) or len(dimensions[1]) % 4:
        raise ValueError("a matrix without flags or dimensions")
    (word,) = struct.unpack_from(f"{order}I", flags[1])
    shape = struct.unpack(f"{order}{len(dimensions[1]) // 4}i", dimensions[1])
    count, of = prod(shape), word & 0xFF
    if min(shape, default=-1) < 0:
        raise ValueError(f"a matrix of {shape}")
    if of in _NUMERIC or of == _CHAR:
        if len(parts) != 1 + bool(word & _COMPLEX):
            raise ValueError(f"a matrix of {len(parts)} parts")
        for item, values in parts:
            # Text may take several bytes a character, and empty text has no type.
            if item not in _ITEM_BYTES or (of != _CHAR and len(values) != count * _ITEM_BYTES[item]):
                raise ValueError(f"{len(values)} bytes of type {item} for a matrix of {shape}")
    elif of in (_CELL, _STRUCT):
        for inner in parts if of == _CELL else parts[2:]:
            _check_matrix(*inner, order, depth + 1)
    # Of sparse matrices, objects and functions, which hold no events, the elements have been found to fit.
