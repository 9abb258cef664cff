"""The live map: the state of every tile and chunk, from the run's own events."""

from __future__ import annotations

import re
from collections import Counter

import pytest

from ppdf_dask.events import Event
from ppdf_dask.maps import PALETTE
from ppdf_dask.params import ChunkParams, RunParams
from ppdf_dask.plan import plan
from ppdf_dask.survey import scan
from ppdf_dask.widget import STATES, LiveMap


@pytest.fixture
def made(small_survey, tmp_path):
    return plan(scan([small_survey / "tiles"]), RunParams(chunks=ChunkParams(chunk_size=40.0)), out=tmp_path / "run")


def states(live: LiveMap) -> Counter[str]:
    named = {PALETTE[colour]: state for state, colour in STATES.items()}
    return Counter(named[colour] for colour in re.findall(r'fill="(#\w+)" fill-opacity', live.html()))


def test_each_piece_has_its_state(made):
    live = LiveMap(made)
    assert states(live) == {"waiting": 9}
    live(Event("tile", "stage", total=100, record={"tasks": 9, "done": 0}))
    live(Event("tile", "done", "s_000003", 20))
    live(Event("tile", "failed", "s_000004", 20))
    live(Event("tile", "retried", "s_000005"))
    assert states(live) == {"waiting": 6, "done": 1, "failed": 1, "tried again": 1}
    assert "2 of 9" in live.html()


def test_what_an_earlier_run_did_is_done(made):
    live = LiveMap(made)
    chunks = [c.id for c in made.chunks]
    live(Event("classify", "stage", points=50, total=100, record={"tasks": 9, "done": 2, "resumed": chunks[:2]}))
    assert states(live) == {"waiting": len(chunks) - 2, "done": 2}
    assert "width:100px" in live.html()


def test_a_whole_run_ends_with_everything_done(made, client):
    live = LiveMap(made)
    made.run(client, on_event=live)
    assert set(states(live)) == {"done"}
    assert live.html().count("<tr>") == 5
    assert "finished" in live.html()


def test_show_redraws_in_place(made, monkeypatch):
    shown = []

    class Handle:
        def update(self, page):
            shown.append(page.data)

    display = pytest.importorskip("IPython.display")
    monkeypatch.setattr(display, "display", lambda page, display_id: Handle())
    live = LiveMap(made, every=0.0)
    live.show()
    live(Event("tile", "stage", total=100, record={"tasks": 9, "done": 0}))
    assert "0 of 9" in shown[-1]
    live(Event("run", "finished"))
    assert "finished" in shown[-1]
