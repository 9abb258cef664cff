"""Chunks of layered LAZ files (point formats 6 to 10): where each one and each of its layers lies.

A chunk is one packed record, then the number of its points and the sizes of its layers (u32 each), then the layers,
each compressed on its own: returns with x and y, z, classification, flags, intensity, scan angle, user data, point
source, time, then colours and one layer per extra byte (LASzip 3).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from ppdf_dask.errors import TileError
from ppdf_dask.lasheader import Laszip

CLASSES = 2
"""Index of the layer that holds the classification."""


@dataclass(frozen=True)
class LayeredChunk:
    """Head of one chunk.

    Attributes
    ----------
    position : int
        First byte of the chunk.
    points : int
        Points it holds.
    head : int
        Bytes before the first layer.
    layers : tuple of int
        Size of each layer, bytes.
    """

    position: int
    points: int
    head: int
    layers: tuple[int, ...]

    @property
    def end(self) -> int:
        """First byte after the chunk."""
        return self.position + self.head + sum(self.layers)

    @property
    def classes(self) -> tuple[int, int]:
        """First byte of the classification layer and first byte after it, counted from the chunk's first byte."""
        begin = self.head + sum(self.layers[:CLASSES])
        return begin, begin + self.layers[CLASSES]


def chunks(file: BinaryIO, laszip: Laszip, record_length: int, start: int, name: str) -> Iterator[LayeredChunk]:
    """Walk the heads of all chunks; each must end before the chunk table.

    Parameters
    ----------
    file : file object
        Read at positions of its own; where it stands between two chunks does not matter.
    laszip : Laszip
        Of the file's header.
    record_length, start : int
        Bytes of a packed record; position of the first chunk.
    name : str
        Of the file, for messages.

    Raises
    ------
    TileError
        A chunk is cut off or claims more than there is.
    """
    head = struct.Struct(f"<I{laszip.layers}I")
    position = start
    for number in range(laszip.chunks):
        if position == laszip.table:
            return
        file.seek(position + record_length)
        data = file.read(head.size)
        if position + record_length + head.size > laszip.table or len(data) < head.size:
            raise TileError(f"{name} is corrupt at byte {position}: chunk {number} is cut off; get it anew")
        points, *layers = head.unpack(data)
        chunk = LayeredChunk(position, points, record_length + head.size, tuple(layers))
        position = chunk.end
        if position > laszip.table:
            raise TileError(
                f"{name} is corrupt: chunk {number} claims to reach byte {position}, beyond the end of the points at "
                f"byte {laszip.table}; get it anew"
            )
        yield chunk
