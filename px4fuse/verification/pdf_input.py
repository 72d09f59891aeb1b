"""Reading of the results attached to a submitted PDF, which may be malicious.

Nothing in the PDF is executed, no link is followed, and nothing is written to disk. Sizes are
checked before pypdf reads the PDF.
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

from px4fuse.core.text import shorten_to_line
from px4fuse.errors import ResultsError
from px4fuse.report.pdf import RESULTS_NAME
from px4fuse.results.contract import ReportedResults, Results
from px4fuse.results.reading import MAX_RESULTS_BYTES as MAX_ATTACHMENT_BYTES
from px4fuse.results.reading import read_results

from .model import BAD_VALUE_ERRORS

MAX_PDF_BYTES = 25_000_000
MAX_PAGES = 100
# Maximum size (bytes) of a decompressed PDF stream
MAX_CONTENT_BYTES = 20_000_000
# Maximum total size (bytes) of all decompressed streams of a PDF
MAX_DOCUMENT_BYTES = 100_000_000
MAX_PDF_OBJECTS = 20_000
MAX_PDF_VALUES = 1_000_000
# Maximum number of references to missing PDF objects: pypdf searches the whole file for each
MAX_UNRESOLVED_REFERENCES = 100

_DAMAGED_REASON = "the PDF is damaged. Hand in the file that px4fuse wrote."
_ENCRYPTED_REASON = "the PDF is encrypted. Hand in the file that px4fuse wrote."
_TOO_COSTLY_REASON = "the PDF needs more memory or time to read than a report of px4fuse."

# Exceptions for damaged PDFs; pypdf also raised AttributeError in a test
BROKEN_PDF_ERRORS = (*BAD_VALUE_ERRORS, PyPdfError, AttributeError, zlib.error)

# Keys of PDF dictionaries with active content, which reports never contain
_ACTIVE_CONTENT_KEY_PATTERN = re.compile(
    "/(JS|JavaScript|XFA|RichMediaContent|RichMediaSettings|Collection|RF)"
)
# Types of PDF actions that run programs or open other files and addresses
_DANGEROUS_ACTION_PATTERN = re.compile(
    "/(JavaScript|Launch|SubmitForm|ImportData|GoToR|GoToE|Rendition|RichMediaExecute|Movie|Sound)"
)

# Limits of pypdf, stricter than its defaults: reports contain only undamaged Flate streams
PYPDF_LIMITS: dict[str, Any] = {
    "maximum_declared_stream_length": MAX_PDF_BYTES,
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

# Allowed compression methods (filters) of a PDF; _check_file limits their decompressed size
_ALLOWED_STREAM_FILTERS = {"/FlateDecode", "/DCTDecode"}

_STREAM_START_PATTERN = re.compile(rb"(?<!end)stream *\r?\n?")


# pypdf must not print warnings about damaged PDFs on the terminal
logging.getLogger("pypdf").setLevel(logging.CRITICAL + 1)


def read_report(pdf: bytes, name: str) -> ReportedResults:
    """Read the results in a report of ``px4fuse compare`` or ``px4fuse loop``.

    ``name`` is the file name for messages.

    Raises
    ------
    ResultsError
        The PDF is not a report, or is a report without KF results.
    """
    results = read_attached_results(pdf, name)
    if not isinstance(results, ReportedResults):
        raise ResultsError(
            f"{shorten_to_line(name, 200)}: the attached {RESULTS_NAME} has no results of KF or of "
            "a loop closure."
        )
    return results


def read_attached_results(pdf: bytes, name: str) -> Results:
    """Read the results attached to a report PDF.

    Raises
    ------
    ResultsError
        The PDF is not a report of px4fuse, is damaged or too large.
    """
    remedy = ""
    try:
        _check_file(pdf)
        with pypdf.apply_configuration(**PYPDF_LIMITS):
            reader = open_strictly(pdf)
            if reader.is_encrypted:
                raise ResultsError(_ENCRYPTED_REASON)
            if not 0 < len(reader.pages) <= MAX_PAGES:
                raise ResultsError(f"the PDF has no pages, or more than {MAX_PAGES} pages.")
            return read_results(_read_attachment(reader), f"the attached {RESULTS_NAME}")
    except ResultsError as error:
        reason, remedy = f"{error.reason}.", error.remedy
    except (LimitReachedError, RecursionError, MemoryError):
        reason = _TOO_COSTLY_REASON
    except DependencyError:  # pypdf cannot decrypt AES without another library
        reason = _ENCRYPTED_REASON
    except BROKEN_PDF_ERRORS:
        reason = _ENCRYPTED_REASON if b"/Encrypt" in pdf else _DAMAGED_REASON
    raise ResultsError(f"{shorten_to_line(name, 200)}: {reason}", remedy)


def open_strictly(pdf: bytes) -> pypdf.PdfReader:
    """Open a PDF without repair, because other programs may repair the PDF differently."""
    return pypdf.PdfReader(
        io.BytesIO(pdf), strict=True, xref_stream_maximum_entries=10 * MAX_PDF_OBJECTS
    )


def _check_file(pdf: bytes) -> None:
    """Test size, start and end of a PDF file, and the sizes of its decompressed streams."""
    if len(pdf) > MAX_PDF_BYTES:
        raise ResultsError(f"the file is larger than {MAX_PDF_BYTES // 1_000_000} MB.")
    if not pdf.startswith(b"%PDF-"):
        raise ResultsError("the file is not a PDF. Hand in the file that px4fuse wrote.")
    if b"%%EOF" not in pdf[-2048:]:
        raise ResultsError("the end of the PDF is missing. Hand in the complete file.")
    # find decompression bombs before pypdf reads the file
    remaining_bytes = MAX_DOCUMENT_BYTES
    for stream_match in _STREAM_START_PATTERN.finditer(pdf):
        # compressed data follow the word "stream". Each such word is tested, even inside other
        # data; if no zlib data follow, the size is 0
        inflated_size_bytes = _estimate_inflated_size_bytes(
            pdf, stream_match.end(), min(remaining_bytes, MAX_CONTENT_BYTES)
        )
        remaining_bytes -= inflated_size_bytes
        if inflated_size_bytes > MAX_CONTENT_BYTES or remaining_bytes < 0:
            raise ResultsError(
                "the decompressed PDF is larger than any px4fuse report: it is not a px4fuse "
                "report, or was printed to PDF. Hand in the original file."
            )


def _estimate_inflated_size_bytes(pdf: bytes, start: int, limit_bytes: int) -> int:
    """Estimate the size (bytes) of the zlib data at ``start`` after decompression.

    Return 0 if no zlib data start there. Otherwise, the result is at least 1000 and at most
    ``limit_bytes`` + 1.
    """
    zlib_header = pdf[start : start + 2]
    if (
        len(zlib_header) < 2
        or zlib_header[0] & 15 != zlib.DEFLATED
        or int.from_bytes(zlib_header) % 31
    ):
        return 0  # not zlib data (RFC 1950, section 2.2)
    decompressor = zlib.decompressobj()
    # decompress at most 1 MB per step until the end of the data or the limit. The input is limited
    # too, because reading needs time even if the output is empty
    input_bytes = output_bytes = 0
    while not decompressor.eof and max(input_bytes, output_bytes) <= limit_bytes:
        # input that the last step has not read because of its limit, otherwise new input
        chunk = decompressor.unconsumed_tail
        if not chunk:
            chunk = pdf[start + input_bytes : start + input_bytes + 16_384]
            input_bytes += len(chunk)
        if not chunk:
            break
        try:
            output_bytes += len(decompressor.decompress(chunk, 1_000_000))
        except zlib.error:
            # pypdf will reject this damaged stream
            break
    # bytes after the end of the data
    input_bytes -= len(decompressor.unused_data)
    # count at least 1000 bytes for each stream, because each start of the decompression needs time
    return min(max(input_bytes, output_bytes, 1000), limit_bytes + 1)


def _walk_dictionaries(reader: pypdf.PdfReader) -> Iterator[tuple[DictionaryObject, bool]]:
    """Yield each PDF dictionary, with True for an action that only runs after a click on a link.

    Such an action is the value of the key /A. An object that another key refers to as well is
    yielded twice, with True and with False. Raise ResultsError if the PDF has too many objects or
    values.
    """
    visited_references: set[tuple[IndirectObject, bool]] = set()
    missing_object_count = value_count = 0
    remaining_values: list[tuple[Any, bool]] = [(reader.trailer, False)]
    while remaining_values:
        value, runs_only_after_click = remaining_values.pop()
        value_count += 1
        if isinstance(value, IndirectObject):
            if (value, runs_only_after_click) in visited_references:
                continue
            visited_references.add((value, runs_only_after_click))
            # pypdf searches the whole file for each object that the cross-reference table omits
            number, generation = value.idnum, value.generation
            is_in_object_stream = generation == 0 and number in reader.xref_objStm
            is_listed = is_in_object_stream or number in reader.xref.get(generation, {})
            missing_object_count += not is_listed
            if (
                len(visited_references) > MAX_PDF_OBJECTS
                or missing_object_count > MAX_UNRESOLVED_REFERENCES
            ):
                raise ResultsError(_TOO_COSTLY_REASON)
            # a reference to a missing object is null (ISO 32000-1, 7.3.10)
            value = value.get_object() if is_listed else None
        if value_count > MAX_PDF_VALUES:
            raise ResultsError(_TOO_COSTLY_REASON)
        if isinstance(value, DictionaryObject):
            yield value, runs_only_after_click
            remaining_values.extend((value.raw_get(key), key == "/A") for key in value)
        elif isinstance(value, ArrayObject):
            remaining_values.extend((element, False) for element in list.__iter__(value))


def _find_unexpected_features(
    dictionary: DictionaryObject, runs_only_after_click: bool
) -> Iterator[str]:
    """Yield the features in a PDF dictionary that px4fuse never writes, for example scripts.

    ``runs_only_after_click`` is True if the dictionary is an action of a link: it may open a URL.
    """
    yield from (key[1:] for key in dictionary if _ACTIVE_CONTENT_KEY_PATTERN.fullmatch(key))
    action, dictionary_type = (
        _read_pdf_name_object(dictionary.get(key)) or "" for key in ("/S", "/Type")
    )
    if _DANGEROUS_ACTION_PATTERN.fullmatch(action):
        yield action[1:]
    if action == "/URI" and not runs_only_after_click:
        yield "an action that opens a URL without a click"
    is_stream = isinstance(dictionary, StreamObject)
    # a file specification without embedded file, or a stream whose content is in another file
    if ("/EF" not in dictionary and dictionary_type in {"/Filespec", "/F"}) or (
        is_stream and "/F" in dictionary
    ):
        yield "a reference to an external file"
    if is_stream:
        filters = resolve_reference(dictionary.get("/Filter"))
        filters = filters if isinstance(filters, ArrayObject) else [filters]
        names = [_read_pdf_name_object(each) or "?" for each in filters if each is not None]
        # a repeated filter could expand to a huge stream
        if not _ALLOWED_STREAM_FILTERS.issuperset(names) or len(set(names)) < len(names):
            compression_text = shorten_to_line(" ".join(names[:3]), 60)
            yield f"a stream with unsupported compression ({compression_text})"


def resolve_reference(value: Any) -> Any:
    """Return the object to which a PDF reference points, or ``value`` if it is not a reference."""
    return value.get_object() if isinstance(value, IndirectObject) else value


def _read_pdf_name_object(value: object) -> str | None:
    value = resolve_reference(value)
    return str(value) if isinstance(value, str) else None


def _read_attachment(reader: pypdf.PdfReader) -> bytes:
    """Return the content of the attached file RESULTS_NAME; other attachments are an error."""
    file_specifications, streams = _find_attachments(reader)
    if not file_specifications and not streams:
        raise ResultsError(
            f"No {RESULTS_NAME} is attached to this PDF. It is not a px4fuse report, or was "
            "printed to PDF. Hand in the original file."
        )
    if len(file_specifications) != 1 or len(streams) != 1:
        raise ResultsError(
            "The PDF has several attachments, or an unreadable one. Hand in one report per PDF."
        )
    # PDF programs may read any of these names
    file_name_keys = {"/UF", "/F", "/DOS", "/Mac", "/Unix"} & file_specifications[0].keys()
    file_names = {str(resolve_reference(file_specifications[0].get(key))) for key in file_name_keys}
    if file_names != {RESULTS_NAME}:
        name_text = shorten_to_line(" / ".join(sorted(file_names)), 80)
        raise ResultsError(f"the name of the attached file is {name_text!r}, not {RESULTS_NAME!r}.")
    attached_bytes = bytes(streams[0].get_data())
    if len(attached_bytes) > MAX_ATTACHMENT_BYTES:
        limit_mb = MAX_ATTACHMENT_BYTES // 1_000_000
        raise ResultsError(f"the attached {RESULTS_NAME} is larger than {limit_mb} MB.")
    return attached_bytes


def _find_attachments(reader: pypdf.PdfReader) -> tuple[list[DictionaryObject], list[Any]]:
    """Return the file specifications and the streams of all attached files.

    A file specification refers to the stream of the file with /EF. Streams of the type
    /EmbeddedFile without file specification are found too.

    Raises
    ------
    ResultsError
        The PDF contains features that px4fuse never writes.
    """
    file_specifications: list[DictionaryObject] = []
    # by identity, so that each stream is listed once
    streams: dict[int, Any] = {}
    unexpected_features: set[str] = set()
    for dictionary, runs_only_after_click in _walk_dictionaries(reader):
        unexpected_features.update(_find_unexpected_features(dictionary, runs_only_after_click))
        if _read_pdf_name_object(dictionary.get("/Type")) == "/EmbeddedFile":
            streams[id(dictionary)] = dictionary
        if "/EF" in dictionary:
            file_specifications.append(dictionary)
            file_by_key: Any = dictionary["/EF"]
            streams |= {id(each): each for each in map(resolve_reference, file_by_key.values())}
    if unexpected_features:
        feature_names_text = ", ".join(sorted(unexpected_features))
        raise ResultsError(f"the PDF contains {feature_names_text}, which px4fuse never writes.")
    return file_specifications, [*streams.values()]
