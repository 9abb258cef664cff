"""Coverage-guided fuzzing of the header, the tile reader and the writer of classified tiles.

::

    python tests/fuzz_reader.py -max_total_time=20          # as in CI
    python tests/fuzz_reader.py -max_total_time=3600 corpus # by hand; findings become cases of `REGRESSIONS`

Whatever the bytes are: the reader gives exactly as many points as the header says, or refuses the file by name, and
never holds more memory than a file of this size can need. A file that can be read is written again: it comes out with
all its points, or is refused by name. Needs ``pip install ppdf-dask[fuzz]`` (atheris).
"""

from __future__ import annotations

import os
import struct
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from lasfiles import OFFSET_TO_POINTS, RECORD_LENGTH, write, write_copc

POINTS = 64


def seeds(folder: Path) -> Iterator[bytes]:
    """Yield small valid files of every kind."""
    rng = np.random.default_rng(0)
    for point_format in (0, 1, 3, 5, 6, 7, 10):
        for suffix in (".las", ".laz"):
            mm = np.column_stack([rng.integers(0, 99_999, POINTS)] * 3)
            path = write(
                folder / f"seed{suffix}", mm, point_format=point_format, offset=(0.0, 0.0, 0.0), crs="EPSG:25832"
            )
            yield path.read_bytes()
    yield write(folder / "seed.las", mm, point_format=4, version="1.3", offset=(0.0, 0.0, 0.0)).read_bytes()
    yield write_copc(folder / "seed.copc.laz", mm, offset=(0.0, 0.0, 0.0), crs="EPSG:25832").read_bytes()


def regressions(folder: Path) -> Iterator[tuple[str, bytes]]:
    """Yield files that once went wrong here or elsewhere, made anew: name and bytes."""
    for k, seed in enumerate(seeds(folder)):
        start = struct.unpack_from("<I", seed, OFFSET_TO_POINTS)[0]
        for name, position, value in (
            ("points in the header", OFFSET_TO_POINTS, struct.pack("<I", 100)),
            ("points behind the end", OFFSET_TO_POINTS, struct.pack("<I", 2**32 - 1)),
            ("no bytes per point", RECORD_LENGTH, struct.pack("<H", 0)),
            ("long records", RECORD_LENGTH, struct.pack("<H", 65535)),
            ("all the points there are", 107, struct.pack("<I", 2**32 - 1)),
            ("count of 2**64 - 1", 247, struct.pack("<Q", 2**64 - 1)),
            ("EVLRs before the file", 235, struct.pack("<QI", 0, 2**32 - 1)),
            ("VLRs without room", 100, struct.pack("<I", 2**32 - 1)),
            ("scale that is no number", 131, struct.pack("<d", float("nan"))),
            ("offset without end", 155, struct.pack("<d", float("inf"))),
            ("table of chunks before the points", start, struct.pack("<q", 1)),
            ("table of chunks behind the end", start, struct.pack("<q", 2**62)),
            ("negative table of chunks", start, struct.pack("<q", -5)),
        ):
            data = bytearray(seed)
            data[position : position + len(value)] = value
            yield f"{k}: {name}", bytes(data)
        for share in (0.1, 0.5, 0.9, 0.999):
            yield f"{k}: cut at {share}", seed[: int(len(seed) * share)]


def check(data: bytes) -> None:
    """Read bytes as a file and write it again; raise AssertionError for an answer that is no file and no refusal."""
    # Imported here, for the fuzzer has to watch the import.
    from ppdf_dask.errors import SurveyError
    from ppdf_dask.grid import ChunkGrid
    from ppdf_dask.merge import rewrite
    from ppdf_dask.params import ClassRules, RunParams
    from ppdf_dask.reader import batches
    from ppdf_dask.survey import scan
    from ppdf_dask.tiler import TileJob

    with tempfile.NamedTemporaryFile(suffix=".laz", dir=_memory()) as file:
        file.write(data)
        file.flush()
        try:
            survey = scan(file.name, assume_units="m")
            tile = survey.tiles[0]
            read = 0
            for batch in batches(tile, unit_xy=1.0, unit_z=1.0, rules=ClassRules(), returns="all", size=1000):
                read += batch.n
                # A compressed point takes more than a ten-thousandth of a byte: the reader's own limit.
                assert read <= 10_000 * len(data)
            assert read == tile.point_count
            target = Path(f"{file.name}.out{Path(tile.name).suffix}")
            job = TileJob("s_000000", tile, 1.0, 1.0, RunParams(), ChunkGrid.from_metres(100.0), 0)
            try:
                assert rewrite(job, target, lambda batch: batch.eligible)["points"] == read
                assert scan(target, assume_units="m").point_count == read
            finally:
                target.unlink(missing_ok=True)
        except SurveyError as error:
            assert file.name in str(error)  # noqa: PT017


def _memory() -> str | None:
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


def main() -> None:
    """Fuzz until libFuzzer's options say stop."""
    try:
        import atheris
    except ImportError:
        sys.exit("fuzzing needs atheris: pip install ppdf-dask[fuzz]")
    with atheris.instrument_imports(include=["ppdf_dask"]):
        import ppdf_dask.merge
        import ppdf_dask.survey  # noqa: F401
    with tempfile.TemporaryDirectory() as folder:
        corpus = Path(folder) / "corpus"
        corpus.mkdir()
        for k, seed in enumerate(seeds(Path(folder))):
            (corpus / str(k)).write_bytes(seed)
        options = ["-max_len=8192", "-rss_limit_mb=2048", "-timeout=20"]
        atheris.Setup([sys.argv[0], *options, *sys.argv[1:], str(corpus)], check)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
