"""Strict reading of results (JSON), which may come from an untrusted source."""

import json
import re
from typing import Any, get_args

import msgspec
from msgspec.structs import fields

from px4fuse.core.record import decode_record_or_unavailable
from px4fuse.core.text import clean_text, convert_nested, shorten_to_line
from px4fuse.errors import ResultsError

from .bounds import find_value_type, list_types
from .contract import RESULTS_BY_SCHEMA, Results
from .model import SCHEMA_VERSION

# Maximum size of a results file (bytes) and of an integer in the file (bits)
MAX_RESULTS_BYTES, MAX_INTEGER_BITS = 5_000_000, 64


def read_results(data: bytes, name: str = "results.json") -> Results:
    """Read results of px4fuse from untrusted bytes.

    ``name`` is the file name for messages.

    Raises
    ------
    ResultsError
        The data are too large, not JSON, nested too deeply, or have another major schema version.
    """
    if len(data) > MAX_RESULTS_BYTES:
        raise ResultsError(f"{name} is larger than {MAX_RESULTS_BYTES // 1_000_000} MB.")
    try:
        decoded_results = convert_nested(msgspec.json.decode(data), _clean_value)
        json.loads(data, object_pairs_hook=_require_unique_keys)
    except RecursionError as error:
        raise ResultsError(f"{name} is nested too deeply.") from error
    except (msgspec.DecodeError, ValueError) as error:
        raise ResultsError(f"{name} is not JSON ({shorten_to_line(str(error), 100)}).") from error
    try:
        schema = decoded_results["schema"]
        results_type, version = RESULTS_BY_SCHEMA[schema["name"]], str(schema["version"])
    except (KeyError, TypeError) as error:
        raise ResultsError(f"{name} contains no results of px4fuse.") from error
    major, minor = SCHEMA_VERSION.split(".")
    if not re.fullmatch(rf"{major}\.[0-9]{{1,4}}", version):
        version_text = "the version that wrote the results"
        provenance = decoded_results.get("provenance")
        if isinstance(provenance, dict) and "px4fuse" in provenance:
            version_text = f"px4fuse {shorten_to_line(str(provenance['px4fuse']), 60)}"
        raise ResultsError(
            f"{name} uses schema version {shorten_to_line(version, 20)}; px4fuse reads version "
            f"{major}.",
            f"Create the report again, or read it with {version_text}.",
        )
    if int(version.partition(".")[2]) > int(minor):
        decoded_results = _remove_unknown_fields(decoded_results, results_type)
    try:
        results: Results = msgspec.convert(
            decoded_results, results_type, dec_hook=decode_record_or_unavailable
        )
    except msgspec.ValidationError as error:
        raise ResultsError(
            f"{name} does not follow the results schema: {shorten_to_line(str(error), 300)}."
        ) from error
    return results


def _remove_unknown_fields(value: Any, annotation: Any) -> Any:
    """Remove fields that are unknown to this version from decoded JSON."""
    types = list_types(annotation)
    if isinstance(value, dict):
        # a union may contain several records, such as a result and Unavailable: keep the fields of
        # all of them, because the type of this record is not known yet
        record_types = [each for each in types if hasattr(each, "__struct_fields__")]
        if not record_types:  # a mapping
            value_type = find_value_type(annotation)
            return {key: _remove_unknown_fields(child, value_type) for key, child in value.items()}
        field_types = {
            field.encode_name: field.type
            for record_type in record_types
            for field in fields(record_type)
        }
        return {
            key: _remove_unknown_fields(child, field_types[key])
            for key, child in value.items()
            if key in field_types
        }
    if isinstance(value, list):
        # X of ``tuple[X, ...]``; a union contains at most one type of tuple
        item_type = next((args[0] for args in map(get_args, types) if args), Any)
        return [_remove_unknown_fields(element, item_type) for element in value]
    return value


def _require_unique_keys(pairs: list[tuple[str, Any]]) -> None:
    # some programs read the first value of a repeated key, others the last
    if len(dict(pairs)) < len(pairs):
        raise ValueError("a JSON key is repeated")


def _clean_value(value: Any) -> Any:
    if isinstance(value, str):
        return clean_text(value)
    if isinstance(value, int) and value.bit_length() > MAX_INTEGER_BITS:
        raise ValueError("an integer has more than 64 bits")
    return value
