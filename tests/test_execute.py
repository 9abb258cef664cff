"""How the pieces of a stage go out and come back: in few messages, within a bounded window, each judged alone."""

from __future__ import annotations

import pickle
from collections import Counter

import pytest
from faulty import Inline, KilledWorker

from ppdf_dask import execute
from ppdf_dask.errors import ClusterError
from ppdf_dask.events import ignore
from ppdf_dask.quarantine import Failure


def double(url, job, fingerprint):
    return {"twice": 2 * int(job[2:])}


STAGE = execute.Stage("classify", double, "", "t")


def works(n):
    return [execute.Work(f"c_{k:04d}", 1, f"c_{k:04d}", "") for k in range(n)]


class Counting(Inline):
    """Counts the tasks of each message and the pieces of each of them; has two threads.

    `spoil` may change futures just before they are fetched.
    """

    def __init__(self, fault=None, spoil=None):
        super().__init__(fault)
        self.sent, self.together, self.fetched, self._spoil = [], [], [], spoil

    def nthreads(self):
        return {"inline": 2}

    def map(self, *arguments, key, pure):
        self.sent.append(len(key))
        self.together.append([len(pickle.loads(packed)) for packed in arguments[-1]])
        return super().map(*arguments, key=key, pure=pure)

    def gather(self, futures, errors):
        self.fetched.append(len(futures))
        if self._spoil is not None:
            self._spoil(futures)
        return super().gather(futures, errors)


def test_what_goes_or_comes_together_is_one_message():
    client, todo = Counting(), works(20)
    assert list(execute.execute(client, STAGE, todo, ignore)) == [(w, {"twice": 2 * k}) for k, w in enumerate(todo)]
    assert client.sent == client.fetched == [6, 6, 6, 2]


@pytest.fixture
def short(monkeypatch):
    """Have every look at the window find that the pieces are as short as can be."""
    monkeypatch.setattr(execute, "POLL", 0.0)


def test_short_pieces_travel_together_but_not_without_end(short):
    client = Counting()
    assert len(list(execute.execute(client, STAGE, iter(works(1000)), ignore))) == 1000
    tasks, widest = 2 * execute.WINDOW_PER_THREAD, 2 * execute.WIDEST_PER_THREAD
    assert client.together[0] == [1] * tasks
    assert max(map(sum, client.together)) == widest
    # What does not divide evenly needs one more.
    assert max(client.sent) == tasks + 1
    assert max(map(max, client.together)) == widest // tasks


def test_a_job_is_made_when_it_is_sent():
    made, ahead = [], []

    def make(given):
        made.append(given)
        return given

    todo = [execute.Work(w.ident, 1, w.job, "", make) for w in works(20)]
    for k, _ in enumerate(execute.execute(Counting(), STAGE, todo, ignore)):
        ahead.append(len(made) - k)
    assert sorted(made) == [w.ident for w in todo]
    assert max(ahead) == 2 * execute.WINDOW_PER_THREAD


def test_pieces_that_take_longer_travel_alone():
    client = Counting()
    list(execute.execute(client, STAGE, works(20), ignore))
    assert {n for message in client.together for n in message} == {1}


def test_a_piece_that_raises_in_company_is_given_up_alone(short):
    def fault(name, job):
        if job == "c_0030":
            raise ValueError("never")

    client, todo = Counting(fault), works(100)
    found = dict(execute.execute(client, STAGE, todo, ignore))
    assert {w.ident for w, outcome in found.items() if isinstance(outcome, Failure)} == {"c_0030"}
    assert sorted(w.ident for w in found) == [w.ident for w in todo]
    # Once in company, which ends there, and as often as any other alone.
    assert Counter(client.ran) == {f"classify-{w.ident}": 1 + (1 + execute.RETRIES) * (w.job == "c_0030") for w in todo}


def test_a_task_that_takes_too_long_sends_back_what_it_has_not_begun(short, monkeypatch):
    monkeypatch.setattr(execute, "OVERDUE", 0.0)
    client, todo = Counting(), works(100)
    found = [w.ident for w, _ in execute.execute(client, STAGE, todo, ignore)]
    assert sorted(found) == [w.ident for w in todo]
    assert max(map(max, client.together)) > 1
    # Each was run once, though some were sent twice.
    assert set(Counter(client.ran).values()) == {1}
    assert sum(map(sum, client.together)) > len(todo)


def test_pieces_whose_worker_died_are_tried_again_one_at_a_time(short):
    def spoil(futures):
        for future in futures.values():
            if "+" in future.key:
                future.status, future.error, future.record = "error", KilledWorker(), None

    client, todo = Counting(spoil=spoil), works(60)
    found = dict(execute.execute(client, STAGE, todo, ignore))
    assert sorted(w.ident for w in found) == [w.ident for w in todo]
    assert not any(isinstance(outcome, Failure) for outcome in found.values())
    assert client.together[-3:] == [[1], [1], [1]]


def test_pieces_sent_together_are_tried_again_and_given_up_alone():
    def fault(name, job):
        if job == "c_0002":
            raise ValueError("never")

    client = Counting(fault)
    found = dict(execute.execute(client, STAGE, works(6), ignore))
    assert {w.ident for w, outcome in found.items() if isinstance(outcome, Failure)} == {"c_0002"}
    assert Counter(client.ran) == {f"classify-c_{k:04d}": 1 + execute.RETRIES * (k == 2) for k in range(6)}


def test_a_record_lost_before_it_was_fetched_is_made_again():
    def spoil(futures):
        for future in futures.values():
            if future.key == "classify-c_0003-t":
                future.status, future.error, future.record = "error", KilledWorker(), None

    client = Counting(spoil=spoil)
    assert dict(execute.execute(client, STAGE, works(6), ignore)) == {
        w: {"twice": 2 * k} for k, w in enumerate(works(6))
    }
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
