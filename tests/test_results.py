"""Contract of the results: written results are read back; untrusted results are checked."""

import json
import math

import jsonschema
import pytest
from comparisons import compare
from exchange import replace
from flights import unexplained
from results_tools import EXAMPLE, LOOP, changed_results, decode_results

import px4fuse
from px4fuse.comparison.model import UntestedFilter
from px4fuse.diagnose import diagnose_comparison
from px4fuse.errors import ResultsError
from px4fuse.flight.model import Flight
from px4fuse.report.pdf import render_pdf
from px4fuse.request import ComparisonRequest
from px4fuse.results import build
from px4fuse.results.bounds import drop_invalid_numbers
from px4fuse.results.contract import RESULTS_BY_SCHEMA, schema, to_json
from px4fuse.results.reading import read_results


def document(flight: Flight, explained: bool = True, **options: object):
    comparison = compare(flight, **options)
    analysis = diagnose_comparison(comparison) if explained else unexplained(comparison)
    return analysis, build.make_comparison_results(ComparisonRequest(log=flight.log.name), analysis)


SCHEMA = schema()


def assert_valid(text: str) -> None:
    """Assert that the text is valid under the schema and unchanged after reading."""
    jsonschema.Draft202012Validator(SCHEMA).validate(json.loads(text))
    assert to_json(read_results(text.encode())) == text


def test_results_schema_is_valid_and_contains_each_result_type():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    kinds = [f"#/$defs/{kind.__name__}" for kind in RESULTS_BY_SCHEMA.values()]
    assert [one["$ref"] for one in SCHEMA["oneOf"]] == kinds


@pytest.mark.parametrize("one", [EXAMPLE, LOOP], ids=["compare", "loop"])
def test_results_schema_rejects_invalid_results(one):
    validator = jsonschema.Draft202012Validator(SCHEMA)
    assert validator.is_valid(json.loads(json.dumps(one)))
    for wrong in (
        {"extra": 1}, {"provenance": ...}, {"schema__name": "px4fuse-tuning"}, {"loop": {}},
        {"schema__version": "1.0"}, {"loop": {"what": "loop"}}, {"student__name": 7},
    ):  # fmt: skip
        assert not validator.is_valid(json.loads(json.dumps(changed_results(one, **wrong)))), wrong


@pytest.mark.parametrize(
    "options",
    [
        {"axes": ("down",), "settings": px4fuse.Settings(input="zero", sigma_a_m_s2=2.0)},
        {"heading_deg": 210.0, "position_source": "ekf2_state_plus_innovation"},
        {"start_s": 40.0, "end_s": 41.0},
    ],
    ids=lambda options: next(iter(options)),
)
def test_results_json_of_any_settings_follows_the_schema(sample_flight, options):
    made = document(sample_flight, **({"start_s": 40.0, "end_s": 70.0} | options))
    text = to_json(made[1])
    assert_valid(text)
    assert render_pdf(*made, text).startswith(b"%PDF-")


def test_nis_of_too_few_updates_is_unavailable_in_results(sample_flight):
    """One second of flight is too short for a test of consistency."""
    _, made = document(sample_flight, start_s=40.0, end_s=41.0)
    north = made.axes["north"]
    assert isinstance(north.filters["kf"], UntestedFilter)
    assert "only 4 measurements" in north.filters["kf"].reason
    assert "nis_mean" not in to_json(north.filters["kf"])
    assert_valid(to_json(made))


def test_results_json_rejects_nan_and_infinity():
    made = decode_results(EXAMPLE)
    for number in (math.nan, math.inf):
        broken = replace(made, settings=replace(made.settings, dt_s=number))
        with pytest.raises(ValueError, match="not JSON compliant"):
            to_json(broken)


# -- untrusted results -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (b"{", "is not JSON"),
        (b'{"a": 1} x', "is not JSON"),
        (b"\xff\xfe{}", "is not JSON"),
        (b'"\\ud800"', "is not JSON"),
        (b"[" * 1_000_000, "nested too deeply"),
        (b'{"a":' * 1_000_000, "nested too deeply"),
        (b"[" * 900 + b"]" * 900, "nested too deeply|no results"),
        (b" " * 5_000_001, "larger than 5 MB"),
        (b"[NaN]", "is not JSON"),
        (b"[-Infinity]", "is not JSON"),
        (b"[1e999]", "out of range"),
        (b"[" + b"9" * 4000 + b"]", "an integer has more than 64 bits"),
        (b"[" + b"9" * 1_000_000 + b"]", "out of range"),
        (b'{"schema": {"name": "px4fuse-other", "version": "2.0"}}', "no results of px4fuse"),
        (b'{"schema": {"name": ["px4fuse-results"], "version": 1}}', "no results of px4fuse"),
        (b'{"schema": "px4fuse-results"}', "no results of px4fuse"),
        (b'[{"a": 1, "b": {}, "a": 2}]', "a JSON key is repeated"),
        (b"[]", "no results of px4fuse"),
        (b"1", "no results of px4fuse"),
        (b'{"schema": {"name": "px4fuse-loop", "version": "3.0"}}', "uses schema version 3.0"),
        (b'{"schema": {"name": "px4fuse-loop", "version": "4.0"}}', "missing required field"),
    ],
    ids=range(21),
)
def test_read_results_from_invalid_json_file_is_rejected(given, said):
    with pytest.raises(ResultsError, match=said) as raised:
        read_results(given, "r.json")
    assert str(raised.value).startswith("r.json ")
    assert str(raised.value).isprintable()
    assert len(str(raised.value)) < 500


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"student__name": "x" * 10_001}, r"length <= 10000 - at `\$.student.name`"),
        ({"extra": 1}, "unknown field `extra`"),
        ({"a\u202eb": 1}, "unknown field `ab`"),
        ({"settings__dt_s": True}, "Expected `float`, got `bool`"),
        ({"settings__dt_s": 0}, "Expected `float` > 0"),
        ({"log__sha256": "x"}, "matching regex"),
        ({"axes": {}}, "length >= 1"),
        ({"axes__up": EXAMPLE["axes"]["down"]}, "Invalid enum value 'up'"),
        ({"axes__north__filters__kf__nis_mean": "1"}, r"at `\$.nis_mean` - at `\$.axes\[...\].f"),
        ({"clock": {"what": "", "reason": ""}}, "missing required field"),
        ({"request__log": ...}, "missing required field `log`"),
        ({"provenance__px4fuse": "1 2"}, "matching regex"),
    ],
    ids=str,
)
def test_results_that_violate_the_schema_are_rejected(values, said):
    with pytest.raises(ResultsError, match=f"does not follow the schema.*{said}|{said}"):
        decode_results(changed_results(**values))


def test_read_results_ignores_fields_of_newer_minor_version():
    known = decode_results(changed_results(schema__version="4.9999"))
    more = changed_results(
        schema__version="4.9999", new=1, log__new={}, axes__aisle__filters__kf__new=[0.0],
        tuning__horizontal__held_out__new=None, source__available=[
            {**one, "new": "x"} for one in EXAMPLE["source"]["available"]],
    )  # fmt: skip
    assert decode_results(more) == known
    assert replace(known, schema=decode_results(EXAMPLE).schema) == decode_results(EXAMPLE)
    with pytest.raises(ResultsError, match="unknown field `new`"):
        decode_results({**more, "schema": EXAMPLE["schema"]})


@pytest.mark.parametrize(
    ("provenance", "said"),
    [({"px4fuse": "0.2.0\n"}, "px4fuse 0.2.0."), (7, "the version that wrote the results.")],
)
def test_error_on_schema_3_results_names_version_that_reads_them(provenance, said):
    with pytest.raises(ResultsError, match=r"schema version 3\.0; .* reads version 4\.") as raised:
        decode_results(changed_results(schema__version="3.0", provenance=provenance))
    assert str(raised.value).endswith(f"Create the report again, or read it with {said}")


def test_read_results_removes_control_characters_from_keys():
    nothing = {"what": "noises", "reason": "too short", "remedy": ""}
    assert list(decode_results(changed_results(tuning={"a\u202eb": nothing})).tuning) == ["ab"]


def test_results_json_numbers_have_ten_significant_digits():
    """Further digits depend on the processor; UNIX times keep microseconds."""
    written = json.loads(to_json({"a": [1 / 3, 2e-7 / 3], "unix_s": 1795251250.2020127, "n": 3}))
    assert written == {"a": [0.3333333333, 6.666666667e-8], "unix_s": 1795251250.202013, "n": 3}
    for text in (EXAMPLE, LOOP):
        once = to_json(text)
        assert to_json(json.loads(once)) == once


def test_results_give_reason_for_number_outside_schema_limits():
    """An optional number is left out alone, a required one with its record."""
    results = read_results(json.dumps(EXAMPLE).encode())
    assert drop_invalid_numbers(results) == results
    axis = results.axes["aisle"]
    kf = replace(axis.filters["kf"], nis_mean=-3.0)
    ekf2 = replace(axis.filters["ekf2"], sigma_p_median_m=1e10)
    wrong = replace(axis, filters={"kf": kf, "ekf2": ekf2})
    found = drop_invalid_numbers(replace(results, axes={"aisle": wrong}))
    filters = found.axes["aisle"].filters
    assert isinstance(filters["kf"], UntestedFilter)
    assert filters["kf"].reason == "axes.aisle.filters.kf.nis_mean is -3 (allowed: 0 to 1e+06)"
    assert filters["kf"].truth == kf.truth
    assert filters["ekf2"] == replace(ekf2, sigma_p_median_m=None)
    assert [one.what for one in found.missing[len(results.missing) :]] == [
        "axes.aisle.filters.ekf2.sigma_p_median_m"
    ]
    assert_valid(to_json(found))


def test_results_without_any_valid_axis_raise_error():
    results = read_results(json.dumps(EXAMPLE).encode())
    wrong = replace(
        results.axes["aisle"], updates=replace(results.axes["aisle"].updates, input_gap_s=math.nan)
    )
    with pytest.raises(
        ResultsError, match=r"axes.aisle.updates.input_gap_s has a value that is not finite"
    ):
        drop_invalid_numbers(replace(results, axes={"aisle": wrong}))
