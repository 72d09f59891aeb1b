"""Malicious PDFs: each is read as a report or rejected with one sentence, in bounded memory."""

import io
import json
import tracemalloc
import zlib
from contextlib import suppress
from pathlib import Path

import pytest
from forgery import pdf_bytes
from pypdf import PdfWriter
from pypdf.generic import (
    ArrayObject,
    DecodedStreamObject,
    DictionaryObject,
    NameObject,
    NumberObject,
    TextStringObject,
)
from results_tools import LOOP, decode_results

from px4fuse.errors import ResultsError
from px4fuse.results.contract import ReportedResults, to_json
from px4fuse.results.model import Student
from px4fuse.verification import pdf_input
from px4fuse.verification.pdf_input import read_report

ROOT = Path(__file__).parent.parent
REAL = (ROOT / "reports" / "example" / "aisle_uwb.pdf").read_bytes()
JSON = (ROOT / "reports" / "example" / "aisle_uwb.json").read_bytes()
DAMAGED = "the PDF is damaged"


def small_report(
    attached: bytes | None = JSON, edit=lambda writer: None, name="results.json"
) -> bytes:
    """Make a PDF of one page with attached results, changed by ``edit``."""
    writer = PdfWriter()
    writer.add_blank_page(100, 100)
    if attached is not None:
        writer.add_attachment(name, attached)
    edit(writer)
    return pdf_bytes(writer)


def raw_pdf(*objects: bytes, trailer: bytes = b"/Root 1 0 R") -> bytes:
    """Make a PDF of raw objects, numbered from 1."""
    out, places = bytearray(b"%PDF-1.4\n"), []
    for number, content in enumerate(objects, start=1):
        places.append(len(out))
        out += b"%d 0 obj\n%b\nendobj\n" % (number, content)
    start = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    out += b"".join(b"%010d 00000 n \n" % place for place in places)
    out += b"trailer\n<< /Size %d %b >>\n" % (len(objects) + 1, trailer)
    return bytes(out + b"startxref\n%d\n%%%%EOF\n" % start)


def stream(data: bytes, entries: bytes = b"") -> bytes:
    return b"<< /Length %d %b >>\nstream\n%b\nendstream" % (len(data), entries, data)


CATALOG = b"<< /Type /Catalog /Pages 2 0 R >>"
PAGES = b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>"
PAGE = b"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 9 9] /Contents 4 0 R /Resources << >> >>"
FLATE = b"/Filter /FlateDecode"


def with_attachment(embedded: bytes, file=b"/F (results.json) /EF << /F 5 0 R >>") -> bytes:
    names = b"/Names << /EmbeddedFiles << /Names [(x) 6 0 R] >> >>"
    catalog = CATALOG.replace(b">>", names + b" >>")
    filespec = b"<< /Type /Filespec %b >>" % file
    return raw_pdf(catalog, PAGES, PAGE, stream(b""), embedded, filespec)


def reason(pdf: bytes) -> str:
    with pytest.raises(ResultsError) as refused:
        read_report(pdf, "r\x1b.\u202epdf")
    said = str(refused.value)
    assert said.startswith("r.pdf: ")
    assert said.isprintable()
    assert len(said) < 400
    return said


def dictionary(**entries: object) -> DictionaryObject:
    return DictionaryObject({NameObject(f"/{name}"): value for name, value in entries.items()})


# ------------------------------------------------------------------ reports


def test_read_report_pdf_returns_its_attached_results():
    report = read_report(REAL, "aisle_uwb.pdf")
    assert to_json(report).encode() == JSON


@pytest.mark.parametrize(("pdf", "results"), [
    (lambda: with_attachment(stream(zlib.compress(JSON), b"/Type /EmbeddedFile " + FLATE)),
     json.loads(JSON)),
    (lambda: small_report(json.dumps(LOOP).encode()), LOOP),
])  # fmt: skip
def test_read_report_pdf_with_compressed_results_succeeds(pdf, results):
    report = read_report(pdf(), "a\nb\u202e\x1b" * 10_000)
    assert report == decode_results(results)


def test_read_resaved_report_pdf_returns_same_results():
    writer = PdfWriter(clone_from=io.BytesIO(REAL))
    again = read_report(pdf_bytes(writer), "r.pdf")
    assert to_json(again).encode() == JSON
    changed = read_report(REAL.replace(b"/Title", b"/Titlf"), "r.pdf")
    assert to_json(changed).encode() == JSON


# ------------------------------------------------------------------ no report


@pytest.mark.parametrize(("pdf", "said"), [
    (b"", "not a PDF. Hand in the file that px4fuse wrote."),
    (b"%PDF-1.4 and no more", "the end of the PDF is missing"),
    (REAL[: len(REAL) // 2], "the end of the PDF is missing"),
    (REAL[:300_000] + b"\n%%EOF\n", DAMAGED),
    (b"%PDF-1.4\nstartxref\n5\n%%EOF", DAMAGED),
    (b"%PDF-1.4\n" + bytes(pdf_input.MAX_PDF_BYTES), "larger than 25 MB"),
    (small_report(None), "printed to PDF. Hand in the original"),
    (
        small_report(name="../../results.json"),
        "name of the attached file is '../../results.json', not 'results.json'",
    ),
    (small_report(name="C:\\results.json"), "the name of the attached file is"),
    (small_report(name="\u202ex\x1b[2J" * 50), "the name of the attached file is"),
    (small_report(edit=lambda w: w.add_attachment("results.json", b"{}")), "several attachments"),
    (raw_pdf(CATALOG, b"<< /Type /Pages /Kids [] /Count 0 >>"), "the PDF has no pages"),
], ids=range(12))  # fmt: skip
def test_read_report_from_unsuitable_pdf_gives_reason(pdf, said):
    assert said in reason(pdf)


def test_read_report_pdf_with_two_attachments_is_rejected():
    embedded = stream(JSON, b"/Type /EmbeddedFile")
    two = with_attachment(embedded, b"/F (results.json) /EF << /F 5 0 R /UF 4 0 R >>")
    assert "several attachments" in reason(two)
    names = with_attachment(embedded, b"/F (results.json) /UF (x.exe) /EF << /F 5 0 R >>")
    assert "results.json / x.exe" in reason(names)


@pytest.mark.parametrize("algorithm", ["RC4-128", "RC4-40"])
def test_read_report_from_encrypted_pdf_is_rejected(algorithm):
    for password in ("", "secret"):
        encrypted = small_report(
            edit=lambda writer, p=password: writer.encrypt(p, algorithm=algorithm)
        )
        assert "encrypted" in reason(encrypted)
    for key in (b"/Encrypt", b"/#45ncrypt"):  # the second one is a damaged key
        trailer = b"/Root 1 0 R %b << /Filter /X >>" % key
        said = reason(raw_pdf(CATALOG, PAGES, PAGE, stream(b""), trailer=trailer))
        assert "encrypted" in said or DAMAGED in said


@pytest.mark.parametrize("count", [101, 3000])
def test_read_report_pdf_with_too_many_pages_is_rejected(count):
    kids = b"<< /Type /Pages /Kids [%b] /Count 1 >>" % (b"3 0 R " * 30 * count)
    assert reason(raw_pdf(CATALOG, kids, PAGE))

    writer = PdfWriter()
    for _ in range(count):
        writer.add_blank_page(9, 9)
    assert reason(pdf_bytes(writer))


# ------------------------------------------------------------------ actions


def on_root(key: str, value: object):
    return lambda writer: writer.root_object.update({NameObject(key): value})


def annotation(**entries: object):
    made = ArrayObject([dictionary(Type=NameObject("/Annot"), **entries)])
    return lambda writer: writer.pages[0].update({NameObject("/Annots"): made})


def action(kind: str, **entries: object) -> DictionaryObject:
    return dictionary(S=NameObject(f"/{kind}"), **entries)


TEXT = TextStringObject("x")


OPENS = dictionary(S=NameObject("/URI"), URI=TextStringObject("http://x"))


def link_and_page_action(writer: PdfWriter) -> None:
    """Use one action for a link and for opening a page."""
    opens = writer._add_object(OPENS)
    annotation(Subtype=NameObject("/Link"), A=opens)(writer)
    turned = dictionary(O=opens)
    writer.pages[0][NameObject("/AA")] = writer._add_object(turned)


ACTS = {
    "opens a URL": on_root("/OpenAction", OPENS),
    "that opens a URL": on_root("/OpenAction", dictionary(S=NameObject("/GoTo"), Next=OPENS)),
    "an action that opens": on_root(
        "/OpenAction", dictionary(S=NameObject("/GoTo"), Next=ArrayObject([OPENS]))
    ),
    "an action that": link_and_page_action,
    "JavaScript": on_root("/Open#41ction", action("JavaScript", JS=TEXT)),
    "contains JavaScript": on_root("/Names", dictionary(JavaScript=dictionary())),
    "contains JS, JavaScript": on_root("/AA", dictionary(WC=action("JavaScript", JS=TEXT))),
    "Launch": on_root("/OpenAction", action("Launch", F=TEXT)),
    "XFA": on_root("/AcroForm", dictionary(XFA=TEXT)),
    "Collection": on_root("/Collection", dictionary()),
    "SubmitForm": on_root("/Outlines", dictionary(A=action("SubmitForm"))),
    "GoToR": on_root("/Outlines", dictionary(A=action("GoToR", F=TEXT))),
    "GoToE": on_root("/Outlines", dictionary(A=action("GoToE"))),
    "a reference to an external": on_root("/X", dictionary(Type=NameObject("/Filespec"), F=TEXT)),
    "Rendition": annotation(Subtype=NameObject("/Screen"), A=action("Rendition")),
    "contains Launch": annotation(Subtype=NameObject("/Link"), A=action("Launch")),
    "contains a reference": annotation(FS=dictionary(Type=NameObject("/Filespec"))),
}


@pytest.mark.parametrize(("said", "edit"), ACTS.items(), ids=ACTS)
def test_report_pdf_with_active_content_is_rejected(edit, said):
    assert said in reason(small_report(edit=edit))
    assert "the PDF contains" in reason(small_report(edit=edit))


@pytest.mark.parametrize("edit", [
    on_root("/OpenAction", ArrayObject([NumberObject(0)])),
    on_root("/AcroForm", dictionary(Fields=ArrayObject())),
    on_root("/Outlines", dictionary(First=dictionary(A=action("URI", URI=TEXT)))),
    annotation(Subtype=NameObject("/Link"), A=action("URI", URI=TEXT)),
    annotation(Subtype=NameObject("/FreeText")),
], ids=range(5))  # fmt: skip
def test_report_pdf_resaved_by_another_program_is_accepted(edit):
    """Other programs add these entries when they save a report."""
    report = read_report(small_report(edit=edit), "r.pdf")
    assert to_json(report).encode() == JSON


# ------------------------------------------------------------------ bombs


def bomb(size: int, entries: bytes = b"/Type /EmbeddedFile ") -> bytes:
    """Make a compressed stream of zeros by repeating one compressed megabyte."""
    count = size // 1_000_000
    squeeze = zlib.compressobj(9, wbits=-zlib.MAX_WBITS)
    million = squeeze.compress(bytes(1_000_000)) + squeeze.flush(zlib.Z_FULL_FLUSH)
    checksum = (count * 1_000_000 % 65521 << 16) + 1  # Adler-32 of zeros
    packed = count * million + squeeze.flush() + checksum.to_bytes(4, "big")
    return stream(b"\x78\xda" + packed, entries + FLATE)


def content_bomb(size: int) -> bytes:
    return raw_pdf(CATALOG, PAGES, PAGE, bomb(size, b""))


def stream_bomb(kind: bytes) -> bytes:
    """Make a bomb in a stream that pypdf decompresses when it opens the file."""
    body = b"%PDF-1.5\n1 0 obj\n" + bomb(
        1_000_000_000, b"/Type /%b /Size 9 /W [1 2 1] /N 9 /First 9 /Root 2 0 R " % kind
    )
    return body + b"\nendobj\nstartxref\n9\n%%EOF\n"


@pytest.mark.parametrize(("pdf", "said"), [
    (with_attachment(bomb(1_000_000_000)), "decompressed PDF is larger"),
    (with_attachment(bomb(8_000_000)), "larger than 5 MB"),
    (with_attachment(stream(bytes(6_000_000), b"/Type /EmbeddedFile")), "larger than 5 MB"),
    (content_bomb(1_000_000_000), "decompressed PDF is larger"),
    (content_bomb(30_000_000), "printed to PDF. Hand in the original"),
    (raw_pdf(CATALOG, *[bomb(15_000_000, b"")] * 8), "decompressed PDF is larger"),
    (stream_bomb(b"XRef"), "decompressed PDF is larger"),
    (stream_bomb(b"ObjStm"), "decompressed PDF is larger"),
], ids=range(8))  # fmt: skip
def test_read_report_pdf_compression_bomb_takes_little_memory(pdf, said):
    tracemalloc.start()
    found, peak = reason(pdf), tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert said in found
    assert peak < 120_000_000


@pytest.mark.parametrize("filters", [
    b"/Filter [" + b"/FlateDecode " * 20 + b"]", b"/Filter [/FlateDecode /FlateDecode]",
    b"/Filter /LZWDecode", b"/Filter /Invented", b"/Filter [/DCTDecode /DCTDecode]", b"/Filter 7",
])  # fmt: skip
def test_report_pdf_with_unsupported_compression_is_rejected(filters):
    attached = with_attachment(stream(zlib.compress(JSON), b"/Type /EmbeddedFile " + filters))
    assert "a stream with unsupported compression" in reason(attached)
    content = raw_pdf(CATALOG, PAGES, PAGE, stream(b"x", filters))
    assert "a stream with unsupported compression" in reason(content)


def test_read_report_pdf_with_many_streams_is_rejected():
    # each keyword starts a decompression; all share one limit
    stored = b"".join(b"stream\x78\x01\x00" + b"\x00\x00\xff\xff\x00" * 3 for _ in range(200_000))
    assert reason(b"%PDF-1.4\n" + stored + b"%%EOF")


# ------------------------------------------------------------------ structure


@pytest.mark.parametrize("pdf", [
    raw_pdf(CATALOG, b"<< /Type /Pages /Kids [3 0 R] >>", b"<< /Type /Pages /Kids [2 0 R] >>"),
    raw_pdf(CATALOG, b"3 0 R", b"2 0 R"),
    raw_pdf(CATALOG, PAGES, PAGE, trailer=b""),
    raw_pdf(CATALOG, PAGES, PAGE, trailer=b"/Root 1 0 R /Prev -5"),
    raw_pdf(CATALOG, PAGES, PAGE, trailer=b"/Root 1 0 R /Prev " + b"9" * 6000),
    raw_pdf(CATALOG, b"<</A" * 100_000),
    raw_pdf(CATALOG, PAGES, PAGE, b"<< /Length 4 0 R >>\nstream\nx\nendstream"),
    raw_pdf(CATALOG, PAGES, b"<< /Type /Page /Contents [%b] >>" % (b"4 0 R " * 9000), stream(b"q")),
    raw_pdf(CATALOG, PAGES, PAGE, stream(b"(" * 5000 + b"[" * 5000 + b"<<" * 5000)),
    b"%PDF-1.4\nxref\n0 99999999\ntrailer\n<< >>\nstartxref\n9\n%%EOF",
    b"%PDF-1.4\n" + b"startxref\n9\n%%EOF\n" * 20_000,
], ids=range(11))  # fmt: skip
def test_read_report_pdf_with_broken_structure_is_rejected(pdf):
    assert reason(pdf)


def test_read_report_pdf_with_invalid_object_stream_is_rejected():
    """Object streams that contain themselves or have wrong offsets."""
    for offsets in (b"1 0 2 9 ", b"5 0 5 3 ", b"1 99 ", b"x y "):
        packed = stream(offsets + CATALOG + PAGES, b"/Type /ObjStm /N 2 /First 8")
        body = b"%PDF-1.5\n5 0 obj\n" + packed + b"\nendobj\n"
        entries = bytes([0, 0, 0, 2, 5, 0, 2, 5, 1, 2, 6, 0, 0, 0, 0, 2, 5, 0])
        table = stream(entries, b"/Type /XRef /Size 6 /W [1 1 1] /Root 1 0 R")
        pdf = body + b"6 0 obj\n" + table + b"\nendobj\nstartxref\n%d\n%%%%EOF" % len(body)
        assert reason(pdf)


def test_read_report_pdf_with_undefined_objects_is_rejected():
    refer = b"".join(b"%d 0 R " % number for number in range(100, 20_000))
    pdf = raw_pdf(b"<< /Type /Catalog /Pages 2 0 R /X [%b] >>" % refer, PAGES, PAGE, stream(b""))
    assert "more memory or time" in reason(pdf)


def test_read_report_pdf_with_too_many_objects_is_rejected():
    catalog = b"<< /Type /Catalog /Pages 2 0 R /X 5 0 R >>"
    listed = b"[%b]" % b"".join(b"%d 0 R " % number for number in range(6, 25_000))
    many = raw_pdf(catalog, PAGES, PAGE, stream(b""), listed, *[b"null"] * 24_995)
    assert "more memory or time" in reason(many)


# ------------------------------------------------------------------ results


def changed(**entries: object) -> bytes:
    return json.dumps(json.loads(JSON) | entries).encode()


def test_read_report_removes_control_characters_from_texts():
    student = {"name": "Zoë \u202eevil\u2066 李\x1b[31m", "id": "=1+1", "notes": "a\n\tb\x07"}
    report = read_report(small_report(changed(student=student)), "r.pdf")
    assert report.student == Student("Zoë evil 李[31m", "=1+1", "a\n\tb")


# ------------------------------------------------------------------ other types


def test_read_report_pdf_of_wrong_object_types_does_not_crash():
    """Values of unexpected types at each key that read_report uses."""
    odd = [NumberObject(7), TEXT, ArrayObject(), dictionary(), DecodedStreamObject()]
    for key in ("/Names", "/Pages", "/Outlines", "/Metadata", "/S", "/Filter", "/EF", "/Annots"):
        for value in odd:
            with suppress(ResultsError):
                assert isinstance(
                    read_report(small_report(edit=on_root(key, value)), "r.pdf"), ReportedResults
                )
