"""Kill a run at any moment, fill its disk, damage its store: the same command goes on to the same bytes."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from faulty import Inline, KilledWorker, at_put, finished, full, in_child, killed, outputs, same, small_plan

from ppdf_dask.errors import DiskFullError, PartialRunError, StoreError
from ppdf_dask.params import RunParams
from ppdf_dask.verify import verify


def puts(undisturbed: Path) -> int:
    return int((undisturbed / "puts.txt").read_text())


def resume(tiles: Path, out: Path, **options: bool) -> list[str]:
    """Go on with a run; check that only unfinished work is done, and return it."""
    done = finished(out)
    client = Inline()
    small_plan(tiles, out).run(client, **options)
    assert not done & set(client.ran), "finished work was done again"
    assert finished(out) == done | set(client.ran)
    return client.ran


def never_claims_too_much(out: Path) -> bool:
    """Tell whether all that the ledger of a killed run calls done is there and whole."""
    try:
        found = verify(out, leave_note=False).findings
    except StoreError:
        return not finished(out)  # It did not come as far as its plan.
    return not [f for f in found if f.redo]


@pytest.mark.parametrize("seed", range(4))
def test_f31_killed_again_and_again_at_random(tiles, undisturbed, tmp_path, seed):
    """Six kills a seed, each anywhere in what is left; then one resume to the end."""
    rng = np.random.default_rng(seed)
    kills = 0
    while kills < 6:
        # Anywhere at first; then again soon, so that later lives begin with something done and little added.
        moment = int(rng.integers(0, puts(undisturbed) // (3 if tmp_path.joinpath("run.zarr").exists() else 1)))

        def life(moment: int = moment) -> None:
            with at_put(moment, killed):
                small_plan(tiles, tmp_path).run(Inline())

        if in_child(life) == -9:
            kills += 1
            assert not (tmp_path / "run.json").exists()
            assert never_claims_too_much(tmp_path)
        else:  # It came to its end before the moment: begin anew.
            assert same(tmp_path, undisturbed)
            shutil.rmtree(tmp_path)
        if kills % 2 == 0 and kills < 6:
            shutil.rmtree(tmp_path, ignore_errors=True)
    resume(tiles, tmp_path)
    assert same(tmp_path, undisturbed)
    assert not list(tmp_path.glob("laz/.*"))


@pytest.mark.slow
def test_f31_killed_at_every_single_put(tiles, undisturbed, tmp_path):
    for moment in range(puts(undisturbed)):
        out = tmp_path / str(moment)

        def life(moment: int = moment, out: Path = out) -> None:
            with at_put(moment, killed):
                small_plan(tiles, out).run(Inline())

        assert in_child(life) == -9
        assert never_claims_too_much(out)
        resume(tiles, out)
        assert same(out, undisturbed), moment
        shutil.rmtree(out)


@pytest.mark.parametrize("stage", ["merge", "cog"])
def test_f46_killed_while_a_file_is_published(tiles, undisturbed, tmp_path, stage, monkeypatch):
    """At `os.replace`: the file is whole under its temporary name, or under its own without a record."""
    import os

    for late in (False, True):
        out = tmp_path / str(late)
        suffix = ".laz" if stage == "merge" else ".tif"

        def life(late: bool = late, out: Path = out, suffix: str = suffix) -> None:
            true = os.replace

            def replace(source: object, target: object) -> None:
                if str(target).endswith(suffix):
                    if late:
                        true(source, target)
                    os.kill(os.getpid(), 9)
                true(source, target)

            os.replace = replace
            small_plan(tiles, out).run(Inline())

        assert in_child(life) == -9
        assert bool(list(out.rglob(f"*{suffix}"))) == late or list(out.rglob(f".*{suffix}*"))
        resume(tiles, out)
        assert same(out, undisturbed)


def test_f39_f34_work_that_runs_twice_at_once_does_no_harm(tiles, undisturbed, tmp_path):
    """A second writer of the same piece interleaves with the first at every put, as a stopped worker that wakes up."""

    class Twice(Inline):
        def map(self, call, *given, **rest):
            def both(*arguments):
                first = call(*arguments)
                with at_put(-1, killed) as keys:
                    call(*arguments)
                for moment in (0, len(keys) // 2, len(keys) - 1):
                    with at_put(moment, lambda key, value, put: (call(*arguments), put())):
                        call(*arguments)
                return first

            return super().map(both, *given, **rest)

    small_plan(tiles, tmp_path).run(Twice())
    assert same(tmp_path, undisturbed)


@pytest.mark.parametrize("moment", [9, 20, 40, 60, 75])
def test_f35_full_disk_in_the_store_ends_the_run_and_it_goes_on(tiles, undisturbed, tmp_path, moment):
    with at_put(moment, full), pytest.raises((DiskFullError, OSError)) as caught:
        small_plan(tiles, tmp_path).run(Inline())
    assert "No space left on device" in str(caught.value)
    assert not (tmp_path / "run.json").exists()
    resume(tiles, tmp_path)
    assert same(tmp_path, undisturbed)


def test_f35_full_disk_in_the_temporary_folder(tiles, undisturbed, tmp_path, monkeypatch):
    """Fragments are spilled at once, into a place where no file may grow."""
    import resource
    import signal

    from ppdf_dask import tiler

    monkeypatch.setattr(tiler, "SPILL_POINTS", 10)

    def life() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (8000, 8000))
        with pytest.raises(DiskFullError, match="temporary folder"):
            small_plan(tiles, tmp_path).run(Inline())

    assert in_child(life) == 0
    assert "tile-s_000000" not in finished(tmp_path)
    monkeypatch.undo()
    resume(tiles, tmp_path)
    assert same(tmp_path, undisturbed)


def test_f35_full_disk_under_everything(tiles, undisturbed, tmp_path):
    """A real small disk: it fills at some moment of some stage; more room, the same command, the same bytes."""
    import os
    import subprocess

    if os.getuid() != 0:
        pytest.skip("only root may mount a small disk")
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=160k", "tmpfs", tmp_path], capture_output=True)
    if mounted.returncode:
        pytest.skip("no leave to mount a small disk here")
    try:
        stopped: list[str] = []
        for size in (160, 320, 640, 1280, 20_000):
            subprocess.run(["mount", "-o", f"remount,size={size}k", tmp_path], check=True)
            try:
                resume(tiles, tmp_path / "run")
            except (DiskFullError, OSError) as error:
                stopped.append(str(error))
                for path in (tmp_path / "run" / "laz").glob("*.laz"):
                    assert outputs(undisturbed)[f"laz/{path.name}"] == outputs(tmp_path / "run")[f"laz/{path.name}"]
        assert stopped
        assert all("o space left" in error for error in stopped)
        assert same(tmp_path / "run", undisturbed)
    finally:
        subprocess.run(["umount", "-l", tmp_path], check=True)


def test_f33_work_that_kills_its_workers_is_tried_alone_and_given_up(tiles, undisturbed, tmp_path):
    def fault(key, job):
        if key == "classify-c_0025_0024":
            raise KilledWorker

    client = Inline(fault)
    with pytest.raises(PartialRunError, match=r"c_0025_0024 \(needs about \d+ MB, a worker has \d+ MB\)"):
        small_plan(tiles, tmp_path).run(client)
    assert client.ran.count("classify-c_0025_0024") == 2
    assert client.ran.index("classify-c_0026_0024") < len(client.ran)
    assert {"classify-c_0024_0024", "classify-c_0026_0024"} <= finished(tmp_path)
    assert resume(tiles, tmp_path)[0] == "classify-c_0025_0024"
    assert same(tmp_path, undisturbed)


def test_what_fails_by_chance_is_tried_again(tiles, undisturbed, tmp_path):
    times = []

    def fault(key, job):
        if key == "merge-s_000000" and len(times) < 2:
            times.append(key)
            raise ConnectionResetError("a storage server had a cold")

    events = []
    small_plan(tiles, tmp_path).run(Inline(fault), on_event=events.append)
    states = [e.state for e in events if e.ident == "s_000000" and e.stage == "merge"]
    assert states == ["sent", "retried", "sent", "retried", "sent", "done"]
    assert same(tmp_path, undisturbed)


def test_overwrite_starts_anew_even_when_killed(tiles, undisturbed, tmp_path):
    small_plan(tiles, tmp_path, dtm=RunParams().dtm.replace(resolution=2.0)).run(Inline())

    def life() -> None:
        with at_put(3, killed):
            small_plan(tiles, tmp_path).run(Inline(), overwrite=True)

    assert in_child(life) == -9
    small_plan(tiles, tmp_path).run(Inline(), overwrite=True)
    assert same(tmp_path, undisturbed)
