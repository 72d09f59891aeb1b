"""Page of px4fuse batch in a browser: filters, 5000 logs, and untrusted text."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from artificial_batch import DAMAGED, NOT_LOGGED, STORY, VEHICLES, artificial_logs
from browser import Browser, Elements, content
from explore_tools import axe, serious
from hypothesis import given, settings
from hypothesis import strategies as st

from px4fuse.batch.page import format_html, summarise_logs
from px4fuse.html.frame import MAX_PAGE_ROWS
from px4fuse.report.card_html import MARKER_SVG_PATHS

MARKUP = '<img src=x onerror="window.alive=1"><b>bold</b>'
BREAKOUT = "</script ></noscript\n><script>window.alive=2</script><!-- \u2028 & &lt;"
HOSTILE = (MARKUP, BREAKOUT, "\0\x1b\u202e", "$title", "javascript:alert(1)", "//a.b/c", "; ;")
TEXTS = (
    "name", "log_sha256", "px4fuse", "settings", "reason", "remedy", "vehicle", "firmware",
    "firmware_hash", "airframe", "hardware", "source", "kf_verdict", "headline", "action",
    "changed", "results", "report",
)  # fmt: skip


def parts(row: list[Any]) -> dict[str, Any]:
    return {part[1]: part for part in (*row[2], *row[3])}


# ------------------------------------------------------------------ without a browser


def test_batch_page_lists_missing_results_of_each_log() -> None:
    table = artificial_logs(30)
    table.loc[table["axis"] == "down", ["reason", "remedy"]] = ("EKF2, down: no heights", "Set it.")
    text = format_html(table, "Bench", "px4fuse 1")
    inside = parts(content(text)["rows"][0])
    assert inside["Missing results"][2] == ["EKF2, down: no heights"]
    assert inside["Actions"][2] == ["Set it."]
    count = table.loc[table["axis"] == "down", "log"].nunique()
    assert f'<option value="Action:Set it.">Set it. ({count})' in text


def test_batch_page_sorts_logs_by_severity_and_rmse() -> None:
    table = artificial_logs(8).drop_duplicates("log").reset_index(drop=True)
    failed = table["status"] != "done"
    table = (
        table[~failed]
        .iloc[:4]
        .assign(
            severity=["clean", "error", "error", "error"],
            kf_source_ratio=[30.0, 2.0, 0.25, 2.0],
            kf_truth_ratio=[1.0, 1.0, 1.0, 1.0],
            ekf2_source_ratio=[1.0, 1.0, 1.0, 1.0],
            position_rmse_m=[1.0, 0.1, 0.1, 0.3],
            name=["a", "b", "c", "d"],
        )
    )
    assert [log["name"] for log in summarise_logs(table)] == ["c", "d", "b", "a"]


def test_batch_page_row_has_diagnosis_and_error_to_sigma_ratios() -> None:
    table = artificial_logs(30)
    rows = [row[0] for row in content(format_html(table, "Bench", "px4fuse 1"))["rows"]]
    first = rows[0]
    assert first[0][0] == "■ ERROR"
    assert first[2][:3] == [STORY, None, "param set EKF2_EVP_NOISE 0.3"]
    assert first[4] == ["12", 12.0, "", "kf truth"]
    assert first[3][3] == "kf source loud"
    assert first[6] == ["", None, "", ""]  # not evaluated
    assert rows[-1][0][0] == "✕ REFUSED"
    assert rows[-1][2][0] in (f"refused: {DAMAGED[0]}", f"not compared: {NOT_LOGGED[0]}")


def test_batch_page_omits_column_without_numbers() -> None:
    table = artificial_logs(4)
    for name in ("clock_offset_s", "sigma_z_m", "kf_truth_ratio", "difference_rms_m"):
        table[name] = np.nan
    table["updates"] = table["updates"].astype("Int64")
    text = format_html(table, "Bench", "px4fuse 1")
    made = content(text)
    cells = made["rows"][0][0]
    assert [cells[place] for place in (4, 7, 11, 12)] == [["", None, "", ""]] * 4
    assert "NaN" not in json.dumps(made)
    assert "nan" not in text.split("<script")[0].split("</style>")[1]


def test_batch_page_without_any_results_lists_failed_logs() -> None:
    assert "0 logs" in format_html(artificial_logs(0), "Bench", "px4fuse 1")
    table = artificial_logs(30)
    failed = table[table["status"] == "failed"].reset_index(drop=True)
    text = format_html(failed, "B", "px4fuse 1")
    assert text == format_html(failed, "B", "px4fuse 1")  # the same table gives the same page
    assert parts(content(text)["rows"][0])["Actions"][2] == [DAMAGED[1]]


def hostile_table(word: str, count: int = 2) -> pd.DataFrame:
    table = artificial_logs(12).iloc[: 3 * count].copy()
    logs = [f"{place // 3}{word}" for place in range(3 * count)]
    return table.assign(**dict.fromkeys(TEXTS, word), findings=f"{word};x", log=logs)


@settings(max_examples=40)
@given(text=st.text(max_size=40) | st.sampled_from(HOSTILE))
def test_batch_page_escapes_text_from_logs(text: str) -> None:
    def shape(word: str) -> list[tuple[str, list[str]]]:
        made = format_html(hostile_table(f"a{word}z"), word, word)
        made.encode()
        assert not re.search("[\x1b\u202e]", made)
        return [(tag, sorted(attributes)) for tag, attributes in Elements(made).found]

    # ";" and "/" separate findings and folders
    assert shape(text.replace(";", ",").replace("/", "|")) == shape("x")


def test_batch_page_links_lead_only_to_relative_paths() -> None:
    bad = ("//example.org/a", "/etc/passwd", "javascript:alert(1)", "https://example.org/")
    table = artificial_logs(4).assign(report=np.repeat(bad, 3), results="")
    rows = content(format_html(table, "a", "b"))["rows"]
    assert len(rows) == 4
    for row in rows:
        files = parts(row).get("Files", ["", "", []])[2]
        assert all(":" not in to and not to.startswith("/") for _, to in files)


# ------------------------------------------------------------------ in a browser


def shown(browser: Browser, folder: Path, table: pd.DataFrame, *titles: str, **how: bool) -> None:
    file = folder / "fleet.html"
    file.write_bytes(format_html(table, *(titles or ("Bench & more", "px4fuse 1"))).encode())
    browser.open(file, **how)


@pytest.fixture
def page(browser: Browser, tmp_path: Path) -> Browser:
    shown(browser, tmp_path, artificial_logs(240))
    return browser


def head(title: str) -> str:
    titles = ("Sign", "Log", "Diagnosis", "KF", "KF truth", "EKF2", "EKF2 truth", "KF − EKF2")
    return f".list > thead th:nth-child({titles.index(title) + 1}) button"


COUNT = "document.querySelector('.count').textContent"


def test_batch_page_sorts_filters_and_opens_rows(page: Browser) -> None:
    page.click(head("KF"))
    page.click("tbody tr:first-child .name")
    ratios = {
        log["name"]: log["kf_source_ratio"]
        for log in summarise_logs(artificial_logs(240))
        if "kf_source_ratio" in log
    }
    assert page.names()[:3] == sorted(ratios, key=lambda name: ratios[name])[:3]
    # a ratio beyond the axis is a triangle at its end
    mark = "document.querySelector('td.k-ratio.truth svg path').getAttribute('d')"
    assert page.ask(mark) == MARKER_SVG_PATHS["above"]
    assert "flight%20" in page.ask("document.querySelector('.more a').href")
    page.choose("#filter-1", "Status:failed")
    assert page.ask(COUNT) == "Showing 24 of 240"
    page.click("#all")
    page.click("#text")
    page.write("bench-2 v1.16")
    assert 0 < len(page.names()) < 40
    assert page.complaints() == []
    assert page.requests() <= {"file", "data"}


def test_batch_page_applies_two_filters_together(page: Browser) -> None:
    table = artificial_logs(240).drop_duplicates("log")
    page.choose("#filter-4", "Finding:EKF2 rejects positions (innovation gate)")
    rejecting = table["findings"].fillna("").str.contains("ekf2_rejects_positions")
    assert page.ask(COUNT) == f"Showing {rejecting.sum()} of 240"
    page.choose("#filter-2", f"Vehicle:{VEHICLES[1]}")
    both = rejecting & (table["vehicle"] == VEHICLES[1])
    assert page.ask(COUNT) == f"Showing {both.sum()} of 240"
    page.click("#all")
    page.choose("#filter-5", f"Action:{NOT_LOGGED[1]}")
    assert page.ask(COUNT) == f"Showing {(table['remedy'] == NOT_LOGGED[1]).sum()} of 240"
    assert page.complaints() == []


def test_batch_page_of_5000_logs_shows_100_rows(browser: Browser, tmp_path: Path) -> None:
    shown(browser, tmp_path, artificial_logs(5000))
    rows = "document.querySelectorAll('.list > tbody > tr').length"
    everything = "document.querySelectorAll('*').length"
    assert browser.ask(rows) == MAX_PAGE_ROWS
    assert browser.ask(everything) < 8000
    assert browser.ask(COUNT) == "Showing 5000 of 5000"
    browser.click(head("KF − EKF2"))
    browser.click("#text")
    browser.write("v1.14")
    assert browser.ask(rows) == MAX_PAGE_ROWS
    browser.click("#all")
    browser.click("#more")
    assert browser.ask(rows) == 2 * MAX_PAGE_ROWS
    browser.click("tbody tr:last-child .name")
    assert browser.ask(rows) == 2 * MAX_PAGE_ROWS + 1
    assert browser.complaints() == []
    assert browser.requests() <= {"file", "data"}


def test_batch_page_without_javascript_shows_a_note(browser: Browser, tmp_path: Path) -> None:
    shown(browser, tmp_path, artificial_logs(4), scripts=False)
    browser.call("Emulation.setScriptExecutionDisabled", value=False)
    text = browser.ask("document.body.innerText")
    assert "Enable JavaScript to show the logs. fleet.csv contains the table of all logs." in text


@pytest.mark.parametrize("width", [360, 1400])
def test_batch_page_has_no_serious_accessibility_violation(page: Browser, width: int) -> None:
    page.resize(width, 800)
    page.click("tbody tr:nth-child(3) .name")
    assert page.ask("document.documentElement.scrollWidth") <= width
    page.ask(axe())
    assert serious(page) == []
