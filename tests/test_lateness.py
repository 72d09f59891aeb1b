"""Due times, late rules, and the times that platforms give."""

from __future__ import annotations

import time
from datetime import UTC, datetime, timedelta, timezone

import pytest

from px4fuse.errors import SettingsError
from px4fuse.grading.entries import due_time, in_zone_of, late_rule, moodle_time

BERLIN = "2026-11-20T23:59:59+01:00"


@pytest.mark.parametrize(
    ("text", "is_"),
    [
        ("2026-11-20 23:59 +01:00", BERLIN),
        ("2026-11-20 23:59 Europe/Berlin", BERLIN),
        ("2026-11-20 22:59:59 +0000", BERLIN),
        ("2026-11-20T22:59Z", BERLIN),
        ("2026-07-20 23:59 Europe/Berlin", "2026-07-20T23:59:59+02:00"),  # summer
        ("2026-11-20 Europe/Berlin", BERLIN),
    ],
)
def test_a_due_time_has_its_zone(text, is_) -> None:
    assert due_time(text) == datetime.fromisoformat(is_)


def test_without_a_zone_it_is_this_computers(monkeypatch) -> None:
    monkeypatch.setenv("TZ", "America/New_York")
    time.tzset()
    try:
        assert due_time("2026-11-20 23:59") == datetime(2026, 11, 21, 4, 59, 59, tzinfo=UTC)
    finally:
        monkeypatch.undo()
        time.tzset()


@pytest.mark.parametrize("text", ["", "tomorrow", "20.11.2026", "2026-11-20 23:59 Mars/Base", "Z"])
def test_what_is_no_time_is_one_line(text) -> None:
    with pytest.raises(SettingsError, match="--due") as caught:
        due_time(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("late_s", "off"), [(0.0, 0), (1.0, 12), (86_400.0, 12), (86_400.5, 24), (1e9, 120)]
)
def test_every_started_day_costs_and_never_more_than_all(late_s, off) -> None:
    assert late_rule("10%/day").deduction(late_s, 120.0) == off


def test_a_rule_may_name_its_limit_and_hours() -> None:
    assert late_rule("1 % / hour up to 5%").deduction(3600.0 * 3.5, 100.0) == 4.0
    assert late_rule("1%/hour up to 5%").deduction(1e6, 100.0) == 5.0


@pytest.mark.parametrize("text", ["", "10", "10%", "-1%/day", "110%/day", "10%/week", "x%/day"])
def test_what_is_no_rule_is_one_line(text) -> None:
    with pytest.raises(SettingsError, match="--late"):
        late_rule(text)


def test_platforms_times_without_a_zone_are_in_that_of_the_due_time() -> None:
    due = due_time("2026-11-20 23:59:00 +05:30")
    bare = datetime(2026, 11, 21, 0, 59)
    assert (in_zone_of(bare, due) - due).total_seconds() == 3600.0
    told = datetime(2026, 11, 20, 18, 29, tzinfo=timezone(timedelta(0)))
    assert in_zone_of(told, due) == due


def test_moodles_words_for_a_time() -> None:
    assert moodle_time("Friday, 20 November 2026, 23:58") == datetime(2026, 11, 20, 23, 58)
    assert moodle_time("Friday, 20 November 2026, 11:58 PM") == datetime(2026, 11, 20, 23, 58)
    assert moodle_time("Freitag, 20. November 2026, 23:58") is None
