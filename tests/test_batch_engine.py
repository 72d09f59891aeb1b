"""Jobs on a cluster: what hangs, crashes or eats memory is lost alone."""

from __future__ import annotations

import sys

import pytest
from batch_tools import Clock, act

import px4fuse
from px4fuse.errors import SettingsError
from px4fuse.fleet import engine
from px4fuse.fleet.engine import WorkerFailed, connected, outcomes


def test_each_bad_job_is_lost_alone_and_its_worker_begins_again(subtests, monkeypatch):
    """What sleeps or exits is among the logs of test_batch.py, and what is tried again there."""
    jobs = [
        ("square", 3), ("square", 4), ("hold the interpreter", 0), ("hog", 4_000),
        ("raise", "no number"), ("square", 5), ("process", 0), ("square", 6),
        ("variable", "OMP_NUM_THREADS"),
    ]  # fmt: skip
    clock = Clock()
    monkeypatch.setattr(engine, "time", clock)
    found = {}
    with connected(workers=2, memory="1GB") as client:
        for work, result in outcomes(client, act, jobs, timeout_s=60.0):
            found[work] = result
            if len(found) == len(jobs) - 1:
                clock.ahead_s = 60.0
        client.wait_for_workers(2, timeout=60)  # both have begun again
    assert list(found) != jobs  # they come as they are done
    for work, expected in {
        ("square", 3): 9,
        ("square", 4): 16,
        ("square", 5): 25,
        ("square", 6): 36,
        ("variable", "OMP_NUM_THREADS"): "1",
        ("hold the interpreter", 0): "longer than 60 s",
        ("hog", 4_000): "ended 3 times: it crashed, or needed more memory",
        ("raise", "no number"): "ValueError: no number",
    }.items():
        with subtests.test(work=work):
            result = found.pop(work)
            if isinstance(result, WorkerFailed):
                assert expected in str(result.error)
            else:
                assert result == expected
    assert set(found) == {("process", 0)}


def test_a_result_that_does_not_come_is_asked_for_again(monkeypatch):
    """Its worker has begun another job and is busy: the scheduler is there all the same."""
    fetched, asked = engine._result, []

    def late(future, *given):
        asked.append(future.key)
        if len(asked) == 1:
            raise TimeoutError("timed out after 10 s.")
        return fetched(future, *given)

    monkeypatch.setattr(engine, "_result", late)
    with connected(workers=1, memory="1GB") as client:
        found = dict(outcomes(client, act, [("square", 3), ("square", 4)], timeout_s=60.0))
    assert found == {("square", 3): 9, ("square", 4): 16}
    assert len(asked) == 3


def test_a_job_that_was_given_to_a_worker_that_had_ended_is_given_to_another(monkeypatch):
    """Its end was not known yet."""
    monkeypatch.setattr(engine, "TICK_S", 0.1)
    with connected(workers=1, memory="1GB") as client:
        known, gone = client.processing, [{"tcp://127.0.0.1:9": ()}]
        monkeypatch.setattr(client, "processing", lambda: gone.pop() if gone else known())
        found = dict(outcomes(client, act, [("square", 3), ("square", 4)], timeout_s=60.0))
    assert found == {("square", 3): 9, ("square", 4): 16}


def test_a_result_that_is_lost_before_it_comes_counts_as_an_ended_worker():
    """It was finished; its worker ended, and so did the one that did the job again."""
    from distributed import KilledWorker

    class Lost:
        status = "finished"

        def result(self, timeout):
            self.status = "error"
            raise self.exception()

        def exception(self):
            return KilledWorker("job", None, 0)

    assert engine._result(Lost()) is engine._ENDED


def test_workers_that_cannot_be_ended_are_refused():
    from distributed import Client

    with (
        Client(
            processes=False,
            n_workers=1,
            threads_per_worker=2,
            dashboard_address=None,
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
        ),
        pytest.raises(SettingsError, match=r"has no nanny; .* --nthreads 1"),
        connected(),
    ):
        pass


def test_a_scheduler_that_does_not_answer_is_one_line(monkeypatch):
    from distributed import default_client

    monkeypatch.setattr(engine, "CONNECT_S", 0.5)
    for address in ("tcp://127.0.0.1:1", "nonsense://x", ""):
        with pytest.raises(SettingsError, match="no Dask scheduler answers"), connected(address):
            pass
    with pytest.raises(ValueError, match="No clients found"):  # the next batch has its own
        default_client()


def test_without_dask_the_extra_is_named(monkeypatch, sample_log):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(SettingsError, match=r'pip install "px4fuse\[batch\]"'):
        px4fuse.batch(sample_log)
