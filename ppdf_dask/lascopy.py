"""What surrounds the points of a LAS file, byte for byte: the header, the records before and those behind the points.

A reader that makes objects of a header and writes them again loses what it has no object for: text in another
encoding, a date of zero, reserved bytes, the order of records, waveforms behind the points. Here only those bytes
change that must: where the points and the records behind them begin, and whether the points are compressed.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from ppdf_dask.lasheader import Header

_VLR = struct.Struct("<H16sHH32s")
_EVLR = struct.Struct("<H16sHQ32s")
_OFFSET, _FORMAT, _WAVEFORM, _EVLRS = 96, 104, 227, 235
_WAVEFORM_INSIDE = 0x02
_BLOCK = 1 << 20


@dataclass(frozen=True)
class Surroundings:
    """All of a file but its points.

    Attributes
    ----------
    head : bytes
        The header block.
    vlrs : tuple of bytes
        The records between header and points, whole, without those of a COPC index.
    laszip : int or None
        Which of them describes the compression, if any.
    gap : bytes
        What lies between the last record and the points.
    tail : tuple of (int, int)
        First byte and end of each piece behind the points that is kept, in the order of the file: extended records
        without those of a COPC index, waveforms.
    evlrs : int
        How many extended records are kept.
    first_evlr, waveform : int
        Where the first of them and the waveforms begin in the source; 0 where there are none.
    """

    head: bytes
    vlrs: tuple[bytes, ...]
    laszip: int | None
    gap: bytes
    tail: tuple[tuple[int, int], ...]
    evlrs: int
    first_evlr: int
    waveform: int

    @classmethod
    def of(cls, file: BinaryIO, header: Header) -> Surroundings:
        """Read the surroundings of a file whose header was checked."""
        file.seek(0)
        raw = file.read(header.offset_to_points)
        size, count = *struct.unpack_from("<H", raw, 94), *struct.unpack_from("<I", raw, 100)
        vlrs: list[bytes] = []
        laszip, position = None, size
        for _ in range(count):
            _, user, _, length, _ = _VLR.unpack_from(raw, position)
            end = position + _VLR.size + length
            if user.split(b"\0")[0] == b"laszip encoded":
                laszip = len(vlrs)
            if not _is_index(user):
                vlrs.append(raw[position:end])
            position = end
        kept = list(_kept_evlrs(file, raw, header))
        waveform = _waveform(raw, header)
        tail = list(kept)
        if waveform and not any(begin <= waveform < end for begin, end in kept):
            end = min([header.size, *(begin for begin, _ in kept if begin > waveform)])
            tail = sorted([*kept, (waveform, end)])
        first = kept[0][0] if kept else 0
        return cls(raw[:size], tuple(vlrs), laszip, raw[position:], tuple(tail), len(kept), first, waveform)

    def begin(self, out: BinaryIO, header: Header, laszip: bytes | None) -> None:
        """Write all that comes before the points.

        Parameters
        ----------
        out : file object
            At its beginning.
        header : Header
            Of the source.
        laszip : bytes or None
            The record that describes the compression; None for plain LAS.
        """
        records = list(self._foreign())
        if laszip is not None:
            # In its old place with its old description, for a copy is to be like the file it was made of.
            old = _VLR.pack(0, b"laszip encoded", 22204, 0, b"") if self.laszip is None else self.vlrs[self.laszip]
            record = bytearray(old[: _VLR.size] + laszip)
            struct.pack_into("<H", record, 20, len(laszip))
            records.insert(len(records) if self.laszip is None else self.laszip, bytes(record))
        head = bytearray(self.head)
        struct.pack_into("<II", head, _OFFSET, len(head) + sum(map(len, records)) + len(self.gap), len(records))
        head[_FORMAT] = header.point_format | (0x80 if laszip is not None else 0)
        out.write(b"".join([bytes(head), *records, self.gap]))

    def end(self, out: BinaryIO, source: BinaryIO) -> None:
        """Write all that comes behind the points, and into the header where it is.

        Parameters
        ----------
        out : file object
            Behind its points.
        source : file object
            The file these are the surroundings of.
        """
        evlrs, waveform = 0, 0
        for begin, end in self.tail:
            here = out.tell()
            evlrs = here if begin == self.first_evlr else evlrs
            waveform = here + self.waveform - begin if begin <= self.waveform < end else waveform
            for block in _blocks(source, begin, end):
                out.write(block)
        minor = self.head[25]
        if minor >= 3 and waveform:
            _patch(out, _WAVEFORM, struct.pack("<Q", waveform))
        if minor >= 4:
            _patch(out, _EVLRS, struct.pack("<QI", evlrs, self.evlrs))

    def _foreign(self) -> Iterator[bytes]:
        """Yield the records in front that say nothing of the compression."""
        yield from (record for k, record in enumerate(self.vlrs) if k != self.laszip)

    def checksum(self, file: BinaryIO) -> int:
        """Return a checksum of all records before and behind the points: equal for a file and its copy."""
        found = zlib.crc32(b"".join([*self._foreign(), self.gap]))
        for begin, end in self.tail:
            for block in _blocks(file, begin, end):
                found = zlib.crc32(block, found)
        return found


def _is_index(user: bytes) -> bool:
    return user.split(b"\0")[0] == b"copc"


def _kept_evlrs(file: BinaryIO, raw: bytes, header: Header) -> Iterator[tuple[int, int]]:
    if header.evlr_count == 0:
        return
    (position,) = struct.unpack_from("<Q", raw, _EVLRS)
    for _ in range(header.evlr_count):
        file.seek(position)
        _, user, _, length, _ = _EVLR.unpack(file.read(_EVLR.size))
        end = position + _EVLR.size + length
        if not _is_index(user):
            yield position, end
        position = end


def _waveform(raw: bytes, header: Header) -> int:
    """Return where the waveforms begin that the file itself holds, 0 when it holds none."""
    if raw[25] < 3 or not raw[6] & _WAVEFORM_INSIDE:
        return 0
    (position,) = struct.unpack_from("<Q", raw, _WAVEFORM)
    return position if header.end_of_points <= position < header.size else 0


def _blocks(file: BinaryIO, begin: int, end: int) -> Iterator[bytes]:
    file.seek(begin)
    while begin < end and (block := file.read(min(_BLOCK, end - begin))):
        begin += len(block)
        yield block


def _patch(out: BinaryIO, position: int, value: bytes) -> None:
    here = out.tell()
    out.seek(position)
    out.write(value)
    out.seek(here)
