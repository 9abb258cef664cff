"""How the pieces of a stage go out and come back: in few messages, within a bounded window, each judged alone."""

from __future__ import annotations

from collections import Counter

import pytest
from faulty import Inline, KilledWorker

from ppdf_dask import execute
from ppdf_dask.errors import ClusterError
from ppdf_dask.events import ignore
from ppdf_dask.quarantine import Failure


def double(url, job, fingerprint):
    return {"twice": 2 * job}


STAGE = execute.Stage("classify", double, "", "t")


def works(n):
    return [execute.Work(f"c_{k:04d}", 1, k, "") for k in range(n)]


class Counting(Inline):
    """Counts the pieces of each message; has two threads; `spoil` may change futures just before they are fetched."""

    def __init__(self, fault=None, spoil=None):
        super().__init__(fault)
        self.sent, self.fetched, self._spoil = [], [], spoil

    def nthreads(self):
        return {"inline": 2}

    def map(self, *arguments, key, pure):
        self.sent.append(len(key))
        return super().map(*arguments, key=key, pure=pure)

    def gather(self, futures, errors):
        self.fetched.append(len(futures))
        if self._spoil is not None:
            self._spoil(futures)
        return super().gather(futures, errors)


def test_what_goes_or_comes_together_is_one_message():
    client, todo = Counting(), works(20)
    assert list(execute.execute(client, STAGE, todo, ignore)) == [(w, {"twice": 2 * w.job}) for w in todo]
    assert client.sent == client.fetched == [6, 6, 6, 2]


def test_the_window_widens_for_short_work_but_not_without_end(monkeypatch):
    monkeypatch.setattr(execute, "POLL", 0.0)
    client = Counting()
    assert len(list(execute.execute(client, STAGE, iter(works(500)), ignore))) == 500
    assert client.sent[0] == 2 * execute.WINDOW_PER_THREAD
    assert max(client.sent) == 2 * execute.WIDEST_PER_THREAD


def test_pieces_sent_together_are_tried_again_and_given_up_alone():
    def fault(name, job):
        if job == 2:
            raise ValueError("never")

    client = Counting(fault)
    found = dict(execute.execute(client, STAGE, works(6), ignore))
    assert {w.job for w, outcome in found.items() if isinstance(outcome, Failure)} == {2}
    assert Counter(client.ran) == {f"classify-c_{k:04d}": 1 + execute.RETRIES * (k == 2) for k in range(6)}


def test_a_record_lost_before_it_was_fetched_is_made_again():
    def spoil(futures):
        for future in futures.values():
            if future.key == "classify-c_0003-t":
                future.status, future.error, future.record = "error", KilledWorker(), None

    client = Counting(spoil=spoil)
    assert dict(execute.execute(client, STAGE, works(6), ignore)) == {w: {"twice": 2 * w.job} for w in works(6)}
    assert client.sent == [6, 1]


def test_records_that_went_with_the_scheduler_end_the_stage():
    def spoil(futures):
        futures["classify-c_0003-t"].status = "cancelled"

    with pytest.raises(ClusterError, match="was lost during classify c_0003"):
        list(execute.execute(Counting(spoil=spoil), STAGE, works(6), ignore))


def test_nothing_is_remembered_of_pieces_that_are_done():
    flight = execute._Flight(Inline(), STAGE, ignore, execute.nothing)
    flight.submit(works(6))
    assert len(list(flight.land())) == 6
    assert flight.tries == flight.flying == {}


def test_records_share_their_words():
    """A driver keeps a record of each chunk of a country."""
    stage = execute.Stage("classify", lambda url, job, fingerprint: {"status": "d" + "one"}, "", "t")
    (_, a), (_, b) = execute.execute(Inline(), stage, works(2), ignore)
    assert a["status"] is b["status"]
    assert next(iter(a)) is next(iter(b))
