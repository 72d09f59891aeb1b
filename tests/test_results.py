"""The results contract: every result validates; the shipped example is what the code computes."""

import json
import math
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from flights import unexplained

import px4fuse
from px4fuse.errors import Px4FuseError
from px4fuse.report.document import Document
from px4fuse.report.pdf import render
from px4fuse.request import ComparisonRequest
from px4fuse.results import build
from px4fuse.results.build import schema, to_json
from px4fuse.results.model import Student

ROOT = Path(__file__).parent.parent


def document(flight: px4fuse.Flight, explained: bool = True, **options: object) -> Document:
    comparison = px4fuse.compare(flight, **options)
    analysis = px4fuse.explain(comparison) if explained else unexplained(comparison)
    return Document(analysis, px4fuse.find(analysis), Student(), "px4fuse compare")


def results(made: Document) -> dict[str, Any]:
    request = ComparisonRequest(log=made.log[0])
    return build.results(request, made.analysis, made.findings, made.student, made.command)


def assert_close(new: object, old: object, where: str) -> None:
    """Equal structure and text; numbers within 1e-6, which other platforms' arithmetic may cost."""
    if isinstance(old, dict):
        assert isinstance(new, dict)
        assert new.keys() == old.keys(), where
        for key in old:
            assert_close(new[key], old[key], f"{where}.{key}")
    elif isinstance(old, list):
        assert isinstance(new, list)
        assert len(new) == len(old), where
        for index, (a, b) in enumerate(zip(new, old, strict=True)):
            assert_close(a, b, f"{where}[{index}]")
    elif isinstance(old, float):
        assert math.isclose(new, old, rel_tol=1e-6, abs_tol=1e-9), f"{where}: {new} is not {old}"
    else:
        assert new == old, where


def test_schema_is_itself_valid():
    jsonschema.Draft202012Validator.check_schema(schema())


def test_shipped_example_is_what_this_code_computes(sample_flight):
    shipped = json.loads((ROOT / "reports" / "aisle_uwb.json").read_text(encoding="utf-8"))
    made = json.loads(to_json(results(document(sample_flight))))
    for part in (shipped, made):  # versions of libraries and the command may differ
        part.pop("provenance")
    assert_close(made, shipped, "results")


def test_shipped_pdf_carries_the_shipped_results():
    import pypdf

    attached = pypdf.PdfReader(ROOT / "reports" / "aisle_uwb.pdf").attachments["results.json"]
    assert attached[0].decode() == (ROOT / "reports" / "aisle_uwb.json").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "options",
    [
        {"axes": ("down",)},
        {"axes": ("aisle",), "heading_deg": 210.0},
        {"settings": px4fuse.Settings(input="zero", sigma_a_m_s2=2.0)},
        {"start_s": 40.0, "end_s": 41.0},
        {"position_source": "ekf2_state_plus_innovation"},
    ],
    ids=lambda options: next(iter(options)),
)
def test_results_of_every_kind_validate_and_render(sample_flight, options):
    made = document(sample_flight, **options)
    text = to_json(results(made))
    jsonschema.validate(json.loads(text), schema())
    assert render(made, text).startswith(b"%PDF-")


def test_nothing_that_could_not_be_computed_is_zero(sample_flight):
    """One second of flight: no consistency statement, but its reason."""
    made = results(document(sample_flight, start_s=40.0, end_s=41.0))
    north = made["axes"]["north"]
    assert "too few" in north["kf"]["unavailable"]["reason"]
    assert "nis_mean" not in north["kf"]
    jsonschema.validate(json.loads(to_json(made)), schema())


@pytest.mark.reallogs
def test_every_log_gives_a_valid_report_or_one_clear_line(shared_logs, subtests):
    """The whole folder, as a student would type it; GPS flights also with GPS as the source."""
    logs = sorted(shared_logs.glob("*/*.ulg"))
    assert len(logs) >= 36
    reported = 0
    for log in logs:
        with subtests.test(log=log.name):
            made = document_or_refusal(log)
            if isinstance(made, str):
                assert "\n" not in made
                assert log.name in made
                continue
            text = to_json(results(made))
            jsonschema.validate(json.loads(text), schema())
            assert render(made, text).startswith(b"%PDF-")
            reported += 1
    assert reported >= 24


# One of a kind: motion capture, outliers and a gap, no IMU to speak of, GPS
EXPLAINED = ("square2", "aisle_nlos", "esc_status", "ekf_failure")


def document_or_refusal(log: Path) -> Document | str:
    try:
        flight = px4fuse.read_log(log)
        gps_alone = [track.name for track in flight.positions] == ["vehicle_gps_position"]
        source = "vehicle_gps_position" if gps_alone else None
        return document(flight, any(part in log.name for part in EXPLAINED), position_source=source)
    except Px4FuseError as error:
        return str(error)
