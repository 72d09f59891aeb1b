"""A handed-in PDF, read without trusting it: a report, or an error that says why not.

Nothing in the file is executed, followed or written anywhere. Sizes are bounded here before pypdf
sees the file, and by pypdf's own limits while it reads; what is left (a file made to be slow
within every limit) is for the time and memory limits of :mod:`px4fuse.workers`.

Of the file only the attached results are read; its pages are only counted, since the report is
drawn again. A file that another program saved again is therefore as good as the original, as long
as its results are still attached.
"""

import io
import logging
import re
import zlib
from collections.abc import Iterator
from typing import Any

import pypdf
from pypdf.errors import DependencyError, LimitReachedError, PyPdfError
from pypdf.generic import ArrayObject, DictionaryObject, IndirectObject, StreamObject

from px4fuse.errors import ResultsError
from px4fuse.report.pdf import RESULTS_NAME
from px4fuse.results.contract import AidsResults, Reported, Results
from px4fuse.results.reading import MAX_BYTES as MAX_ATTACHMENT_BYTES
from px4fuse.results.reading import one_line, read_results
from px4fuse.verification.model import BAD_VALUES

MAX_BYTES = 25_000_000
MAX_PAGES = 100
# Of one stream, and of all together
MAX_CONTENT_BYTES = 20_000_000
MAX_DOCUMENT_BYTES = 100_000_000
MAX_OBJECTS = 20_000
MAX_VALUES = 1_000_000
# Objects that are referred to and not there: pypdf searches the whole file for each of them
MAX_MISSING = 100

_DAMAGED_REASON = "damaged: it cannot be read as a PDF. Hand in the file that px4fuse wrote."
_ENCRYPTED_REASON = "encrypted. Hand in the file that px4fuse wrote."
_COSTLY_REASON = "it takes more memory or work to open than a report can need."

# 900 files with a few bytes changed gave AttributeError too. What is none of these is a mistake of
# ours, and stands as such in the row of that file
BROKEN_PDF_ERRORS = (*BAD_VALUES, PyPdfError, AttributeError, zlib.error)

# What acts: keys of a dictionary ... Links, comments, forms without scripts and the view to open
# with are what programs add that save a report again
_KEYS = re.compile("/(JS|JavaScript|XFA|RichMediaContent|RichMediaSettings|Collection|RF)")
# ... and types of an action
_ACTIONS = re.compile(
    "/(JavaScript|Launch|SubmitForm|ImportData|GoToR|GoToE|Rendition|RichMediaExecute|Movie|Sound)"
)

# pypdf's defaults are for any PDF. A recovery of broken streams, filters other than Flate, chains
# of filters and the external JBIG2 decoder are not for ours.
PYPDF_LIMITS: dict[str, Any] = {
    "maximum_declared_stream_length": MAX_BYTES,
    "array_based_stream_maximum_output_length": MAX_CONTENT_BYTES,
    "zlib_maximum_output_length": MAX_CONTENT_BYTES,
    "zlib_maximum_recovery_input_length": 0,
    "lzw_maximum_output_length": 1,
    "run_length_maximum_output_length": 1,
    "brotli_maximum_output_length": 1,
    "jbig2_maximum_output_length": 1,
    "jbig2dec_binary": None,
    "stream_filters_maximum_length": 1,
    "stream_parsing_work_maximum_count": 1_000_000,
    "page_tree_maximum_entries": 2 * MAX_PAGES,
    "page_tree_maximum_page_entries": 100 * MAX_PAGES,
}

# Of content that is not ours to decode: what PDF writers use today, and of which none is a bomb
# that inflating every stream once does not find
_FILTERS = frozenset(("/FlateDecode", "/DCTDecode"))

_STREAM = re.compile(rb"(?<!end)stream *\r?\n?")


# What pypdf thinks of a broken file is not for the instructor's terminal
logging.getLogger("pypdf").setLevel(logging.CRITICAL + 1)


def read_report(pdf: bytes, name: str) -> Reported:
    """Read a report that was handed in.

    Parameters
    ----------
    pdf : bytes
        Anything.
    name : str
        What to call the file in errors.

    Returns
    -------
    ComparisonResults or LoopResults
        What is attached.

    Raises
    ------
    ResultsError
        From :func:`attached_results`, or what is attached cannot be verified: the aids of EKF2
        alone.
    """
    results = attached_results(pdf, name)
    if not isinstance(results, Reported):
        content = "no results of a report"
        if isinstance(results, AidsResults):
            content = "the aids of EKF2 alone, nothing of our filter"
        raise ResultsError(f"{one_line(name, 200)}: {RESULTS_NAME} in it holds {content}.")
    return results


def attached_results(pdf: bytes, name: str) -> Results:
    """The results attached to a PDF, their strings cleaned.

    Raises
    ------
    ResultsError
        It is not one that px4fuse can have written.
    """
    remedy = ""
    try:
        _check_file(pdf)
        with pypdf.apply_configuration(**PYPDF_LIMITS):
            reader = opened(pdf)
            if reader.is_encrypted:
                raise ResultsError(_ENCRYPTED_REASON)
            if not 0 < len(reader.pages) <= MAX_PAGES:
                raise ResultsError(f"a PDF without pages, or with more than {MAX_PAGES}.")
            return read_results(_attachment(reader), f"{RESULTS_NAME} in it")
    except ResultsError as refusal:
        reason, remedy = f"{refusal.reason}.", refusal.remedy
    except (LimitReachedError, RecursionError, MemoryError):
        reason = _COSTLY_REASON
    except DependencyError:  # pypdf decrypts AES with a library that px4fuse does not need
        reason = _ENCRYPTED_REASON
    except BROKEN_PDF_ERRORS:
        reason = _ENCRYPTED_REASON if b"/Encrypt" in pdf else _DAMAGED_REASON
    raise ResultsError(f"{one_line(name, 200)}: {reason}", remedy)


def opened(pdf: bytes) -> pypdf.PdfReader:
    """Open a PDF within the limits, strictly: programs repair a damaged file in different ways."""
    return pypdf.PdfReader(
        io.BytesIO(pdf), strict=True, xref_stream_maximum_entries=10 * MAX_OBJECTS
    )


def _check_file(pdf: bytes) -> None:
    for has_problem, why in (
        (len(pdf) > MAX_BYTES, f"larger than {MAX_BYTES // 1_000_000} MB; reports are below 2 MB."),
        (not pdf.startswith(b"%PDF-"), "not a PDF: hand in the file that px4fuse wrote."),
        (b"%%EOF" not in pdf[-2048:], "cut off: the end of the PDF is missing. Hand it in again."),
    ):
        if has_problem:
            raise ResultsError(why)
    # every stream is inflated into nothing, so that no bomb reaches pypdf
    remaining_bytes = MAX_DOCUMENT_BYTES
    for match in _STREAM.finditer(pdf):
        # `stream` may stand anywhere, also inside a stream; each try counts towards the same limit
        spent = _inflated_bytes(pdf, match.end(), min(remaining_bytes, MAX_CONTENT_BYTES))
        remaining_bytes -= spent
        if spent > MAX_CONTENT_BYTES or remaining_bytes < 0:
            raise ResultsError("a compressed part of it expands to more than a report can hold.")


def _inflated_bytes(pdf: bytes, start: int, limit: int) -> int:
    """Bytes that zlib data at ``start`` takes or gives, whichever is more, up to limit + 1."""
    head = pdf[start : start + 2]
    if len(head) < 2 or head[0] & 15 != zlib.DEFLATED or int.from_bytes(head) % 31:
        return 0  # RFC 1950, section 2.2: not zlib data
    inflate = zlib.decompressobj()
    input_bytes = output_bytes = 0
    while not inflate.eof and max(input_bytes, output_bytes) <= limit:
        if not (feed := inflate.unconsumed_tail):
            feed = pdf[start + input_bytes : start + input_bytes + 16_384]
            input_bytes += len(feed)
        if not feed:
            break
        try:
            output_bytes += len(inflate.decompress(feed, 1_000_000))
        except zlib.error:  # pypdf, told not to repair, has no more use for it
            break
    input_bytes -= len(inflate.unused_data)
    # the least is what a try costs, however little is there
    return min(max(input_bytes, output_bytes, 1000), limit + 1)


def _dictionaries(reader: pypdf.PdfReader) -> Iterator[tuple[DictionaryObject, bool]]:
    """All that a viewer can reach, each object once, without decoding it.

    With whether a viewer comes there by a click alone: the action of a link or of an outline.
    """
    visited: set[tuple[IndirectObject, bool]] = set()
    missing_count = value_count = 0
    remaining: list[tuple[Any, bool]] = [(reader.trailer, False)]
    while remaining:
        value, clicked = remaining.pop()
        value_count += 1
        if isinstance(value, IndirectObject):
            if (value, clicked) in visited:
                continue
            visited.add((value, clicked))
            # in the cross-reference table, so that no search is needed for it
            number, generation = value.idnum, value.generation
            is_packed = generation == 0 and number in reader.xref_objStm
            is_listed = is_packed or number in reader.xref.get(generation, {})
            missing_count += not is_listed
            if len(visited) > MAX_OBJECTS or missing_count > MAX_MISSING:
                raise ResultsError(_COSTLY_REASON)
            # ISO 32000-1, 7.3.10: a reference to an object that is not there is null
            value = value.get_object() if is_listed else None
        if value_count > MAX_VALUES:
            raise ResultsError(_COSTLY_REASON)
        if isinstance(value, DictionaryObject):
            yield value, clicked
            remaining.extend((value.raw_get(key), key == "/A") for key in value)
        elif isinstance(value, ArrayObject):
            remaining.extend((each, False) for each in list.__iter__(value))


def _foreign_features(value: DictionaryObject, clicked: bool) -> Iterator[str]:
    """What a dictionary has that a report has not."""
    yield from (key[1:] for key in value if _KEYS.fullmatch(key))
    action, kind = _name(value.get("/S")) or "", _name(value.get("/Type"))
    if _ACTIONS.fullmatch(action):
        yield action[1:]
    if action == "/URI" and not clicked:
        yield "an action that opens an address"
    is_stream = isinstance(value, StreamObject)
    if ("/EF" not in value and kind in {"/Filespec", "/F"}) or (is_stream and "/F" in value):
        yield "a reference to another file"
    if is_stream:
        filters = _resolve(value.get("/Filter"))
        names = list(filters) if isinstance(filters, ArrayObject) else [filters]
        used_names = [_name(each) for each in names if each is not None]
        if not _FILTERS.issuperset(used_names) or len(set(used_names)) != len(used_names):
            filter_names = " ".join(each or "?" for each in used_names[:3])
            yield f"a stream packed by other means ({one_line(filter_names, 60)})"


def _resolve(value: object) -> object:
    return value.get_object() if isinstance(value, IndirectObject) else value


def _name(value: object) -> str | None:
    value = _resolve(value)
    return str(value) if isinstance(value, str) else None


def _attachment(reader: pypdf.PdfReader) -> bytes:
    """Bytes of the one attached file; its name is compared and used for nothing else."""
    files: list[DictionaryObject] = []
    streams: dict[int, StreamObject] = {}
    features: set[str] = set()
    for value, clicked in _dictionaries(reader):
        features.update(_foreign_features(value, clicked))
        candidates: list[object] = [value] if _name(value.get("/Type")) == "/EmbeddedFile" else []
        if "/EF" in value:
            files.append(value)
            versions = _resolve(value.get("/EF"))
            candidates += versions.values() if isinstance(versions, DictionaryObject) else ()
        objects = map(_resolve, candidates)
        streams |= {
            id(candidate): candidate for candidate in objects if isinstance(candidate, StreamObject)
        }
    if features:
        raise ResultsError(f"it contains {', '.join(sorted(features))}; no report does.")
    if not files and not streams:
        raise ResultsError.of("no_results_attached", name=RESULTS_NAME)
    if len(files) != 1 or len(streams) != 1:
        raise ResultsError.of("attachments_many")
    (file,), (stream,) = files, streams.values()
    names = {
        str(_resolve(file.get(key)))
        for key in ("/UF", "/F", "/DOS", "/Mac", "/Unix")
        if key in file
    }
    if names != {RESULTS_NAME}:
        name_text = one_line(" / ".join(sorted(names)), 80)
        raise ResultsError(f"the attached file is called {name_text!r}, not {RESULTS_NAME!r}.")
    data = bytes(stream.get_data())
    if len(data) > MAX_ATTACHMENT_BYTES:
        limit = MAX_ATTACHMENT_BYTES // 1_000_000
        raise ResultsError(f"{RESULTS_NAME} in it is larger than {limit} MB.")
    return data
