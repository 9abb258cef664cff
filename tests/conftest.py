"""Shared fixtures: labelled clouds where the machine has them, a small survey, a cluster in threads."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from distributed import Client, LocalCluster

from ppdf_dask.synthetic import SyntheticParams, write_survey


@pytest.fixture(scope="session")
def data() -> Path:
    """Folder of the labelled clouds; tests that want it are skipped, visibly, where it is not set."""
    folder = os.environ.get("PPDF_DASK_DATA")
    if not folder:
        pytest.skip("PPDF_DASK_DATA is not set: no labelled clouds here")
    return Path(folder)


@pytest.fixture(scope="session")
def small_survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write nine 40 m tiles of forest on a hillside, about 35 000 points, with truth/ beside tiles/."""
    folder = tmp_path_factory.mktemp("survey")
    write_survey(folder, SyntheticParams(density=1.5), extent=(600, 600, 720, 720), tile_size=40)
    return folder


@pytest.fixture(scope="session")
def client() -> Iterator[Client]:
    """Give a real scheduler and two worker threads inside this process: quick, and debuggable."""
    with (
        LocalCluster(n_workers=1, threads_per_worker=2, processes=False, dashboard_address="127.0.0.1:0") as cluster,
        Client(cluster) as made,
    ):
        yield made


@pytest.fixture(scope="session")
def tiles(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write two tiles of 40 m that share a chunk, five thousand points; return their folder."""
    folder = tmp_path_factory.mktemp("tiny")
    params = SyntheticParams(density=1.0, low_noise=0.001)
    write_survey(folder, params, extent=(600, 600, 680, 640), tile_size=40, truth=False)
    return folder / "tiles"


@pytest.fixture(scope="session")
def undisturbed(tiles: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run the survey of `tiles` as the fault tests do, with nothing in its way; ``puts.txt`` counts its writes."""
    from faulty import Inline, at_put, finished, killed, small_plan

    from ppdf_dask import tiler

    out, client = tmp_path_factory.mktemp("undisturbed"), Inline()
    with at_put(-1, killed) as keys, pytest.MonkeyPatch.context() as patched:
        patched.setattr(tiler, "WORTH_KEEPING", 0)
        small_plan(tiles, out).run(client)
    assert finished(out) == set(client.ran)
    (out / "puts.txt").write_text(str(len(keys)))
    return out


@pytest.fixture(autouse=True)
def labels_of_small_tiles(request: pytest.FixtureRequest) -> Iterator[None]:
    """Let the fault tests find labels in their stores, though their tiles are too small to be worth it."""
    from ppdf_dask import tiler

    with pytest.MonkeyPatch.context() as patched:
        if "tiles" in request.fixturenames:
            patched.setattr(tiler, "WORTH_KEEPING", 0)
        yield
