"""Submitted PDFs compared with the redrawn report: forged differ, re-saved do not."""

from __future__ import annotations

import io
import random
import re
from collections.abc import Callable
from functools import partial
from typing import Any

import pikepdf
import pytest
from cli_tools import run_checked
from conftest import REPORT, SAMPLES
from forgery import (
    Edit,
    Forge,
    append_update,
    array,
    box,
    catalogue,
    dictionary,
    document_info,
    edit_stream,
    font,
    forged,
    glyphs,
    name,
    on_page,
    pdf_bytes,
    replace_stream,
    stream,
    text,
)
from pypdf import PdfReader, PdfWriter
from pypdf.generic import (
    ArrayObject,
    BooleanObject,
    ByteStringObject,
    DecodedStreamObject,
    DictionaryObject,
    NameObject,
    NumberObject,
    TextStringObject,
)

from px4fuse.api import write_report
from px4fuse.diagnose import diagnose
from px4fuse.errors import ResultsError
from px4fuse.request import ComparisonRequest
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import Scenario
from px4fuse.verification import pages
from px4fuse.verification.model import PageDifference
from px4fuse.verification.pages import COORDINATE_TOLERANCE_PT, compare_pages
from px4fuse.verification.pdf_input import read_report
from px4fuse.verification.verification import (
    is_same_number_up_to_rounding,
    is_same_text_up_to_rounding,
)

STRING = TextStringObject
N = NumberObject
ON = BooleanObject(True)


@pytest.fixture(scope="module")
def pdf(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Report with tables and figures."""
    target = tmp_path_factory.mktemp("loop") / "loop.pdf"
    run_checked("loop", f"{SAMPLES / 'loop_vio.ulg'}:ekf2", "-o", target)
    return target.read_bytes()


@pytest.fixture(autouse=True)
def _in_this_process(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "time_limit" not in request.node.name:
        monkeypatch.setattr(pages, "run_one_with_limits", lambda function, job, *_: function(job))


def equal_text(one: str, other: str) -> bool:
    return one == other


def compare(
    one: bytes, other: bytes, alike: Callable[[str, str], bool] = equal_text
) -> tuple[PageDifference, ...]:
    return compare_pages(one, other, alike)


# -- forgeries ------------------------------------------------------------------------------------


def page(number: int, key: str, value: Any) -> Forge:
    return lambda writer: writer.pages[number - 1].update({NameObject(key): value})


def resource(kind: str, key: str, value: Any) -> Forge:
    """Add a resource of the first page, without using it."""

    def forge(writer: PdfWriter) -> None:
        held: Any = writer.pages[0]["/Resources"]
        part = held.setdefault(NameObject(kind), DictionaryObject()).get_object()
        part[NameObject(key)] = writer._add_object(value)

    return forge


def draw_on_page(add: bytes, *forges: Forge) -> Forge:
    """Append drawing operations to page 1, with the resources that they use."""

    def forge(writer: PdfWriter) -> None:
        for one in (*forges, on_page(1, lambda content: content + b"\n" + add)):
            one(writer)

    return forge


def content(change: Callable[[bytes], bytes]) -> Forge:
    return on_page(1, change)


def once(pattern: bytes, new: bytes | Callable[[re.Match[bytes]], bytes]) -> Edit:
    return lambda content: re.sub(pattern, new, content, count=1, flags=re.DOTALL)


def annotation(subtype: str, **entries: Any) -> Forge:
    """Put an annotation with a white appearance over the verdict."""
    form = stream(b"1 g 0 0 300 90 re f", Type=name("XObject"), Subtype=name("Form"),
                  BBox=box(0, 0, 300, 90))  # fmt: skip

    def forge(writer: PdfWriter) -> None:
        look = dictionary(N=writer._add_object(form))
        one = dictionary(Type=name("Annot"), Subtype=name(subtype), Rect=box(50, 690, 350, 780),
                         AP=look, **entries)  # fmt: skip
        writer.pages[0][NameObject("/Annots")] = array(writer._add_object(one))

    return forge


def field(kind: str, **entries: Any) -> Forge:
    """Put a form field over page 1, which viewers draw from its value."""

    def forge(writer: PdfWriter) -> None:
        annotation("Widget", FT=name(kind), T=STRING("f"), F=N(4), **entries)(writer)
        fields: Any = writer.pages[0]["/Annots"]
        form = dictionary(Fields=ArrayObject(fields), NeedAppearances=ON)
        writer.root_object[NameObject("/AcroForm")] = form

    return forge


def layer(used: bytes, **states: Any) -> Forge:
    """Paint a white patch in a layer, visible by its usage."""

    def forge(writer: PdfWriter) -> None:
        group = dictionary(Type=name("OCG"), Name=STRING("x"), Usage=dictionary(**states))
        held = writer._add_object(group)
        events = array(dictionary(Event=name("Print"), OCGs=array(held)))
        shown = dictionary(Order=array(), AS=events)
        writer.root_object[NameObject("/OCProperties")] = dictionary(OCGs=array(held), D=shown)
        resource("/Properties", "/MC0", group)(writer)
        content(lambda held: held + used)(writer)

    return forge


def image(**entries: Any) -> DecodedStreamObject:
    return stream(b"\xff", Type=name("XObject"), Subtype=name("Image"), Width=N(1), Height=N(1),
                  BitsPerComponent=N(8), ColorSpace=name("DeviceGray"), **entries)  # fmt: skip


def descendant(key: str, value: Any) -> Forge:
    return lambda writer: font("/f0")(writer)["/DescendantFonts"][0].update(
        {NameObject(key): value}
    )


def descriptor(writer: PdfWriter) -> Any:
    return font("/f0")(writer)["/DescendantFonts"][0]["/FontDescriptor"]


def exchanged_glyphs(writer: PdfWriter) -> None:
    """Map glyphs so that the font draws 9 instead of 1; the extracted text is unchanged."""
    letters = glyphs(font("/f0")(writer))
    numbers = list(range(max(letters.values()) + 1))
    one, nine = letters["1"], letters["9"]
    numbers[one], numbers[nine] = nine, one
    held = stream(b"".join(number.to_bytes(2, "big") for number in numbers))
    descendant("/CIDToGIDMap", writer._add_object(held))(writer)


def exchanged_outlines(data: bytes) -> bytes:
    """Return a TrueType font with exchanged outlines of glyphs 3 and 5."""
    count = int.from_bytes(data[4:6], "big")
    tables = {data[12 + 16 * at : 16 + 16 * at]: data[20 + 16 * at : 24 + 16 * at]
              for at in range(count)}  # fmt: skip
    at = int.from_bytes(tables[b"loca"], "big")
    wide = data[int.from_bytes(tables[b"head"], "big") + 51]
    size = 4 if wide else 2
    made = bytearray(data)
    made[at + 3 * size : at + 4 * size], made[at + 5 * size : at + 6 * size] = (
        data[at + 5 * size : at + 6 * size], data[at + 3 * size : at + 4 * size])  # fmt: skip
    return bytes(made)


def structure(change: Callable[[Any], None]) -> Forge:
    """Change the element of the first figure in the structure tree."""

    def forge(writer: PdfWriter) -> None:
        left: list[Any] = [writer.root_object["/StructTreeRoot"]["/K"]]  # type: ignore[index]
        while left:
            value = left.pop().get_object()
            if isinstance(value, ArrayObject):
                left += list.__iter__(value)
            elif isinstance(value, DictionaryObject):
                if value.get("/S") == "/Figure":
                    change(value)
                    return
                left += [value.raw_get("/K")] if "/K" in value else []

    return forge


def put(key: str, value: Any) -> Callable[[Any], None]:
    return lambda holder: holder.update({NameObject(key): value})


def kids(change: Callable[[list[Any]], list[Any]]) -> Forge:
    def forge(writer: PdfWriter) -> None:
        tree: Any = writer.root_object["/Pages"]
        made = change(list(tree["/Kids"]))
        tree.update({NameObject("/Kids"): ArrayObject(made), NameObject("/Count"): N(len(made))})

    return forge


def rotated_parent(writer: PdfWriter) -> None:
    """Give a page another parent with a rotation, which some viewers apply."""
    other = writer._add_object(
        dictionary(Type=name("Pages"), Kids=array(), Count=N(0), Rotate=N(180))
    )
    writer.pages[0][NameObject("/Parent")] = other


def second_content(writer: PdfWriter) -> None:
    sheet = writer.pages[0]
    white = writer._add_object(stream(b"1 g 0 0 600 850 re f"))
    sheet[NameObject("/Contents")] = array(sheet.raw_get("/Contents"), white)


def contents_in_an_array(writer: PdfWriter) -> None:
    sheet = writer.pages[0]
    sheet[NameObject("/Contents")] = array(sheet.raw_get("/Contents"))


def another_font(writer: PdfWriter) -> None:
    fonts: Any = writer.pages[0]["/Resources"]["/Font"]  # type: ignore[index]
    fonts[NameObject("/f0")] = fonts.raw_get("/f1")


def type3(writer: PdfWriter) -> None:
    fonts: Any = writer.pages[0]["/Resources"]["/Font"]  # type: ignore[index]
    drawing = writer._add_object(stream(b"0 0 0 0 1 1 d1 0 0 1 1 re f"))
    fonts[NameObject("/f0")] = writer._add_object(dictionary(
        Type=name("Font"), Subtype=name("Type3"), FontBBox=box(0, 0, 1, 1),
        FontMatrix=box(1, 0, 0, 1, 0, 0), CharProcs=dictionary(a=drawing),
        Encoding=dictionary(Differences=array(N(0), name("a"))), FirstChar=N(0), LastChar=N(0),
        Widths=array(N(1)),
    ))  # fmt: skip


def another_file(writer: PdfWriter) -> None:
    writer.add_attachment("more.txt", b"more")


def jpeg_content(writer: PdfWriter) -> None:
    """Mark the content as JPEG: the page is empty in viewers, and unchanged in pypdf."""
    held = edit_stream(writer.pages[0]["/Contents"].get_object(), lambda data: data + b" ")
    held.set_data(writer.pages[0]["/Contents"].get_object().get_data())
    held[NameObject("/Filter")] = name("DCTDecode")
    writer.pages[0][NameObject("/Contents")] = writer._add_object(held)


def bookmark(writer: PdfWriter) -> None:
    writer.root_object["/Outlines"]["/First"].update(  # type: ignore[index]
        {NameObject("/Title"): STRING("consistent")}
    )


def spread_text(content: bytes, writer: PdfWriter) -> bytes:
    """Replace the first 1 on page 1 by a 2 far from the letters before it."""
    letters = glyphs(font("/f0")(writer))
    one, two = (text(letters[digit]) for digit in "12")
    return content.replace(one, b")-9000(" + two, 1)


def other_digit(writer: PdfWriter) -> None:
    """Replace the first 1 on page 1 by a 2."""
    letters = glyphs(font("/f0")(writer))
    one, two = (text(letters[digit]) for digit in "12")
    content(once(re.escape(one), lambda _: two))(writer)


WHITE = b"q 1 g 50 690 300 90 re f Q"
# Forgery, the beginning of a difference, and whether it is one of structure
FORGERIES: dict[str, tuple[Forge, str, bool]] = {
    # form fields
    "an empty form": (catalogue("/AcroForm", dictionary(Fields=array())), "entry /AcroForm", True),
    "a text field": (field("Tx", V=STRING("0.95"), DA=STRING("/f0 8 Tf")), "entry /Annots", True),
    "a button": (field("Btn", MK=dictionary(CA=STRING("ok"))), "entry /Annots", True),
    "a choice": (field("Ch", V=STRING("a"), Opt=array(STRING("a"))), "entry /Annots", True),
    "a signature": (field("Sig"), "entry /Annots", True),
    "a widget without a form": (annotation("Widget", FT=name("Tx")), "entry /Annots", True),
    "an XFA form": (
        catalogue("/AcroForm", dictionary(Fields=array(), XFA=STRING("x"))),
        "entry /AcroForm", True,
    ),
    # layers
    "a layer for print": (
        layer(b"\n/OC /MC0 BDC " + WHITE + b" EMC", Print=dictionary(PrintState=name("ON")),
              View=dictionary(ViewState=name("OFF"))), "entry /OCProperties", True,
    ),
    "a layer for the screen": (
        layer(b"\n/OC /MC0 BDC " + WHITE + b" EMC", View=dictionary(ViewState=name("ON"))),
        "entry /OCProperties", True,
    ),
    "a list of layers": (
        catalogue("/OCProperties", dictionary(OCGs=array())), "entry /OCProperties", True,
    ),
    # annotations
    **{
        f"annotation {kind}": (annotation(kind, **entries), "entry /Annots", True)
        for kind, entries in {
            "FreeText": {"Contents": STRING("0.01"), "DA": STRING("/f0 8 Tf")},
            "Stamp": {"F": N(4)}, "Square": {"F": N(36)}, "Highlight": {}, "Ink": {},
            "Link": {}, "Redact": {}, "Watermark": {"F": N(4)}, "Popup": {}, "Line": {},
        }.items()
    },
    "no annotations": (page(1, "/Annots", array()), "entry /Annots", True),
    # fonts
    "glyphs exchanged by a map": (exchanged_glyphs, "/CIDToGIDMap has a wrong type", True),
    "outlines exchanged": (
        replace_stream(descriptor, "/FontFile2", exchanged_outlines), "/FontFile2 was changed",
        False,
    ),
    "letters exchanged": (
        replace_stream(font("/f0"), "/ToUnicode", lambda c: c.replace(b"> <0031>", b"> <0039>")),
        "the PDF entry /ToUnicode was changed", False,
    ),
    "widths": (descendant("/W", array(N(0), N(60), N(0))), "the PDF array /W has 3 elements", True),
    "the default width": (descendant("/DW", N(900)), "entry /DW was changed to '900'", False),
    "vertical widths": (descendant("/DW2", array(N(0), N(1))), "an entry /DW2", True),
    "another encoding": (
        lambda w: font("/f0")(w).update({NameObject("/Encoding"): name("Identity-V")}),
        "the PDF entry /Encoding was changed to '/Identity-V'", False,
    ),
    "another name": (
        lambda w: font("/f0")(w).update({NameObject("/BaseFont"): name("Helvetica")}),
        "the PDF entry /BaseFont was changed to '/Helvetica'", False,
    ),
    "no font program": (lambda w: descriptor(w).pop("/FontFile2"), "an entry /FontFile2", True),
    "a second font program": (
        lambda w: descriptor(w).update({NameObject("/FontFile3"): w._add_object(stream(b"x"))}),
        "an entry /FontFile3", True,
    ),
    "another font under the name": (another_font, "the PDF entry /BaseFont was changed", True),
    "a Type3 font": (type3, "an entry /CharProcs", True),
    "one font more": (resource("/Font", "/f9", dictionary()), "an entry /f9", True),
    # content of a page
    "the colour of the verdict": (
        content(once(rb"/c0 cs [\d. ]+ scn", b"/c0 cs 0 0.6 0 scn")), "drawing operation", False,
    ),
    "a colour a little": (
        content(once(rb"/c0 cs 0\.2\d+ 0\.2", b"/c0 cs 0.5 0.2")), "drawing operation", False,
    ),
    "another digit": (other_digit, "contains the text ", False),
    "a white rectangle": (draw_on_page(WHITE), "drawing operation", False),
    "points of a plot erased": (
        content(once(rb"[\d.]+ [\d.]+ l (?=[\d.]+ [\d.]+ l )", b"")), "drawing operation", False,
    ),
    "a mark erased": (
        content(once(rb"q 1 0 0 -1 [\d. ]+ cm[^Q]*?-2.5 2.5 m[^Q]*?h\nB\nQ\n", b"")),
        "drawing operation", False,
    ),
    "a point of a line moved": (
        content(once(rb"([\d.]+) ([\d.]+) l\b", lambda m: b"%.3f %s l" % (float(m[1]) + 1, m[2]))),
        "drawing operation", False,
    ),
    "a text moved": (
        content(once(rb"q 1 0 0 -1 ([\d.]+)", rb"q 1 0 0 -1 9\1")), "drawing operation", False,
    ),
    "a text enlarged": (content(once(rb"/f0 8 Tf", b"/f0 9 Tf")), "drawing operation", False),
    "a text squeezed": (
        content(once(rb"1 0 0 -1 0 0 Tm", b"0.8 0 0 -1 0 0 Tm")), "drawing operation", False,
    ),
    "a text invisible": (content(once(rb"BT 0 Tr", b"BT 3 Tr")), "drawing operation", False),
    "letter moved": (
        content(once(rb"\)(-?[\d.]+)\(", rb")-9000(")), "contains the text ", False,
    ),
    "a letter a little aside": (
        content(once(rb"\)(-?[\d.]+)\(", rb")150(")), "contains the text ", False,
    ),
    "a text less": (content(once(rb"\[\([^]]*\]TJ", b"[]TJ")), "contains the text ", False),
    "the page clipped": (
        content(lambda c: b"0 0 300 300 re W n\n" + c), "drawing operation 1 ", False,
    ),
    "the page emptied": (content(lambda _: b"\n"), "drawing operation 1 ", False),
    "the page mirrored": (
        content(lambda c: b"-1 0 0 1 595 0 cm\n" + c), "drawing operation 1 ", False,
    ),
    "a line without width": (
        content(once(rb" [\d.]+ w ", b" 0 w ")), "drawing operation", False,
    ),
    "the description of a figure": (
        content(once(rb"/Alt\(", b"/Alt(x")), "drawing operation", False,
    ),
    "another text for readers": (
        content(once(rb"/Span<</MCID 0>>", b"/Span<</MCID 0/ActualText(x)>>")),
        "drawing operation", False,
    ),
    "an inline image": (
        draw_on_page(b"BI /W 1 /H 1 /BPC 8 /CS /G ID \xff EI"), "drawing operation", False,
    ),
    "a long content": (content(lambda c: c * 5), "the PDF entry /Contents was changed", False),
    "a comment": (content(lambda c: c + b"\n% x\n"), "drawing operation", False),
    "a second content stream": (second_content, "PDF entry /Contents has a wrong type", True),
    "an array of contents": (contents_in_an_array, "PDF entry /Contents has a wrong type", True),
    "content taken for a JPEG": (jpeg_content, "the compression of the PDF entry /Contents", True),
    # resources
    "an image": (
        draw_on_page(b"q 300 0 0 90 50 690 cm /X Do Q", resource("/XObject", "/X", image())),
        "an entry /XObject", True,
    ),
    "an image with alternates": (
        resource("/XObject", "/X", image(Alternates=array(dictionary(DefaultForPrinting=ON)))),
        "an entry /XObject", True,
    ),
    "an image with a proxy": (
        resource("/XObject", "/X", image(OPI=dictionary())), "an entry /XObject", True,
    ),
    "an image with a mask": (
        resource("/XObject", "/X", image(SMask=image())), "an entry /XObject", True,
    ),
    "a form XObject": (
        draw_on_page(b"/X Do", resource("/XObject", "/X", stream(WHITE, Subtype=name("Form"),
                                                          BBox=box(0, 0, 600, 850)))),
        "an entry /XObject", True,
    ),
    "a soft mask": (
        draw_on_page(b"/g9 gs", resource("/ExtGState", "/g9", dictionary(SMask=name("None")))),
        "an entry /ExtGState", True,
    ),
    "a shading": (
        draw_on_page(b"/s0 sh", resource("/Shading", "/s0", dictionary(ShadingType=N(1)))),
        "an entry /Shading", True,
    ),
    "a pattern": (resource("/Pattern", "/p9", stream(WHITE)), "an entry /Pattern", True),
    "a colour space": (
        resource("/ColorSpace", "/c0", array(name("DeviceCMYK"))), "the PDF array /c0 has 1", True,
    ),
    "a property list": (
        resource("/Properties", "/MC0", dictionary(ActualText=STRING("x"))),
        "an entry /Properties", True,
    ),
    # pages
    "a page turned": (page(2, "/Rotate", N(180)), "an entry /Rotate", True),
    "a page cut": (page(2, "/CropBox", box(0, 0, 300, 300)), "an entry /CropBox", True),
    "a page smaller": (page(2, "/MediaBox", box(0, 0, 595.2756, 400)), "the PDF entry", False),
    "a page trimmed": (page(2, "/TrimBox", box(0, 0, 300, 300)), "an entry /TrimBox", True),
    "a page in another unit": (page(2, "/UserUnit", N(2)), "an entry /UserUnit", True),
    "a page in a group": (page(1, "/Group", dictionary(S=name("Transparency"))),
                          "an entry /Group", True),
    "a thumbnail": (page(1, "/Thumb", image()), "an entry /Thumb", True),
    "an action of a page": (page(1, "/AA", dictionary()), "an entry /AA", True),
    "a page shown for a second": (page(1, "/Dur", N(1)), "an entry /Dur", True),
    "another parent": (rotated_parent, "an entry /Rotate", True),
    "an inherited rotation": (
        lambda w: w.root_object["/Pages"].update({NameObject("/Rotate"): N(90)}),  # type: ignore[attr-defined]
        "an entry /Rotate", True,
    ),
    "the first page away": (kids(lambda k: k[1:]), "", False),
    "a page twice": (kids(lambda k: [*k[:2], *k[1:]]), "", False),
    "a page more": (kids(lambda k: [*k, k[0]]), "pages; the recomputed report has 2", False),
    "two pages exchanged": (kids(lambda k: [k[1], k[0], *k[2:]]), "", False),
    # the document
    "an opening action": (
        catalogue("/OpenAction", array()), "an entry /OpenAction", True,
    ),
    "actions": (catalogue("/AA", dictionary()), "an entry /AA", True),
    "a mode of display": (catalogue("/PageMode", name("FullScreen")), "an entry /PageMode", True),
    "a layout": (catalogue("/PageLayout", name("TwoPageLeft")), "an entry /PageLayout", True),
    "page labels": (
        catalogue("/PageLabels", dictionary(Nums=array(N(0), dictionary(P=STRING("verified"))))),
        "an entry /PageLabels", True,
    ),
    "viewer preferences": (
        catalogue("/ViewerPreferences", dictionary(HideMenubar=ON)), "an entry /HideMenubar", True,
    ),
    "a bookmark": (bookmark, "the PDF entry /Title was changed to 'consistent'", False),
    "no bookmarks": (lambda w: w.root_object.pop("/Outlines"), "lacks an entry /Outlines", True),
    "named places": (catalogue("/Dests", dictionary()), "an entry /Dests", True),
    "a base address": (
        catalogue("/URI", dictionary(Base=STRING("http://x"))), "an entry /URI", True,
    ),
    "another language": (
        catalogue("/Lang", STRING("de")), "the PDF entry /Lang was changed to 'de'", False,
    ),
    "no structure tree": (
        lambda w: w.root_object.pop("/StructTreeRoot"), "an entry /StructTreeRoot", True,
    ),
    "a description in the structure": (structure(put("/Alt", STRING("x"))), "the PDF", False),
    "a text in the structure": (
        structure(put("/ActualText", STRING("x"))), "an entry /ActualText", True,
    ),
    "another attachment": (another_file, "the PDF array /Names has 4 elements", True),
    "a description of the attachment": (
        lambda w: w.root_object["/AF"][0].update({NameObject("/Desc"): STRING("x")}),  # type: ignore[index]
        "the PDF entry /Desc was changed to 'x'", False,
    ),
    "a collection": (catalogue("/Collection", dictionary()), "an entry /Collection", True),
    "permissions": (catalogue("/Perms", dictionary()), "an entry /Perms", True),
    "another version": (catalogue("/Version", name("2.0")), "an entry /Version", True),
    # metadata
    "another title": (document_info(Title="verified by px4fuse"), "the PDF entry /Title", False),
    "another author": (
        document_info(Author="Ada"), "the PDF entry /Author was changed to 'Ada'", False,
    ),
    "another creator": (document_info(Creator="Typst 1 by Ada"), "the PDF entry /Creator", False),
    "a subject": (document_info(Subject="verified"), "an entry /Subject", True),
    "XMP's title": (
        replace_stream(lambda w: w.root_object, "/Metadata",
                 lambda c: c.replace(b"px4fuse loop", b"verified:")), "/Metadata was", False,
    ),
    "XMP with entities": (
        replace_stream(lambda w: w.root_object, "/Metadata",
                 lambda c: c.replace(b"?><x:", b'?><!DOCTYPE a [<!ENTITY b "c">]><x:')),
        "/Metadata was", False,
    ),
    "XMP that is no XML": (
        replace_stream(lambda w: w.root_object, "/Metadata", lambda c: c + b"<"), "the PDF cannot",
        True,
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", FORGERIES)
def test_pdf_comparison_detects_forged_report_page(pdf: bytes, kind: str) -> None:
    forge, said, structural = FORGERIES[kind]
    found = compare(forged(pdf, forge), pdf)
    assert any(said in one.what for one in found), found
    assert any(one.is_structural for one in found) == structural, found
    assert len(found) <= pages.MAX_LISTED_DIFFERENCES + 1
    assert all(one.what.isprintable() and len(one.what) < 200 for one in found)


def later_generation(pdf: bytes) -> bytes:
    """Replace an object by one of another generation, which some programs ignore."""
    number = int(re.findall(rb"/Contents (\d+) 0 R", pdf)[0])
    made = pdf.replace(b"/Contents %d 0 R" % number, b"/Contents %d 1 R" % number)
    made = made.replace(b"\n%d 0 obj" % number, b"\n%d 1 obj" % number)
    at = made.rfind(b"xref\n0 ")
    at = made.index(b"\n", at + 5) + 1 + 20 * number
    assert made[at + 10 : at + 18] == b" 00000 n"
    return made[: at + 15] + b"1" + made[at + 16 :]


def shadowed(pdf: bytes) -> bytes:
    """Append an object table after the end, which PDFium uses."""
    return pdf + b"\nstartxref\n9\n"


def linearised(pdf: bytes) -> bytes:
    """Add an object table at the beginning, which viewers of linearised files use."""
    first = pdf.find(b"\n", 10) + 1
    begin = b"9999 0 obj\n<</Linearized 1/L 9>>\nendobj\nxref\n0 0\ntrailer<<>>\n"
    offset = len(begin)
    at = pdf.rfind(b"startxref")
    table = pdf.rfind(b"xref\n", 0, at)
    moved = re.sub(
        rb"(\d{10}) (00000) n", lambda m: b"%010d 00000 n" % (int(m[1]) + offset), pdf[table:at]
    )
    return (
        pdf[:first]
        + begin
        + pdf[first:table]
        + moved
        + b"startxref\n%d\n%%%%EOF" % (table + offset)
    )


def hybrid(pdf: bytes) -> bytes:
    """Add a second object table, which older programs do not read."""
    at = pdf.rfind(b"trailer")
    return pdf[:at] + pdf[at:].replace(b"<<", b"<<\n/XRefStm 15\n", 1)


def empty_first_page(writer: PdfWriter) -> None:
    """Remove the content of the first page."""
    held = edit_stream(writer.pages[0]["/Contents"].get_object(), lambda _: b" ")
    writer.pages[0][NameObject("/Contents")] = writer._add_object(held)


FILES: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "a version appended": (lambda pdf: append_update(pdf, empty_first_page), "drawing operation"),
    "a table behind the end": (shadowed, "the file has bytes after the end of the PDF"),
    "bytes behind the end": (lambda pdf: pdf + b"\n% Eve\n", "bytes after the end of the PDF"),
    "a table at the beginning": (linearised, "second cross-reference table"),
    "a hybrid table": (hybrid, "second cross-reference table"),
    "a later generation": (later_generation, "another program changed the PDF entry /Contents"),
    "a key twice": (
        lambda pdf: pdf.replace(b"/Tabs/S", b"/Tabs/S/Tabs/S", 1), "the PDF cannot be read",
    ),
    "no end": (lambda pdf: pdf[: pdf.rfind(b"startxref")], ""),
    "nothing": (lambda _: b"", ""),
}  # fmt: skip


@pytest.mark.parametrize("kind", FILES)
def test_pdf_comparison_detects_forged_file_structure(pdf: bytes, kind: str) -> None:
    forge, said = FILES[kind]
    made = forge(pdf)
    assert made != pdf
    found = compare(made, pdf)
    assert any(said in one.what for one in found), found


def test_pdf_comparison_detects_changed_fill_pattern(tmp_path) -> None:
    """The plots of a flight with a gap in the position source contain a hatched band."""
    flight = simulate_flight(Scenario(seed=1, passes=1), parse_faults(["dropout=5"]))
    request = ComparisonRequest(log=flight.log.name)
    report = write_report(diagnose(request, flight=flight), tmp_path / "report.pdf")
    pdf = report.read_bytes()
    at = next(at for at, sheet in enumerate(PdfReader(report).pages, 1)
              if "/Pattern" in sheet["/Resources"])  # type: ignore[operator] # fmt: skip
    patterns = replace_stream(
        lambda w: w.pages[at - 1]["/Resources"]["/Pattern"],  # type: ignore[index]
        "/p0", lambda c: re.sub(rb"[\d.]+ (scn|SCN)", rb"0 \1", c, count=1),
    )  # fmt: skip
    (found,) = compare(forged(pdf, patterns), pdf)
    assert (found.page, found.is_structural) == (at, False)


# -- unforged files -----------------------------------------------------------------------------


def recompress(writer: PdfWriter) -> None:
    """Merge identical objects and compress again, as other programs do."""
    writer.compress_identical_objects(remove_duplicates=True)
    for sheet in writer.pages:
        sheet.compress_content_streams(level=9)


def decompress(writer: PdfWriter) -> None:
    for sheet in writer.pages:
        held = sheet["/Contents"].get_object()
        plain = DecodedStreamObject()
        plain.set_data(held.get_data())  # type: ignore[attr-defined]
        sheet[NameObject("/Contents")] = writer._add_object(plain)


def save_metadata(writer: PdfWriter) -> None:
    """Set producer and dates, as programs do when they save a file."""
    document_info(Producer="Another program", ModDate="D:20260101000000Z")(writer)
    dates = rb"<xmp:ModifyDate>[^<]*</xmp:ModifyDate>"
    new = (
        b"<xmp:ModifyDate>2026-01-01</xmp:ModifyDate><xmp:MetadataDate>2026</xmp:MetadataDate>"
        b"<pdf:Producer>Another program</pdf:Producer>"
    )
    replace_stream(lambda w: w.root_object, "/Metadata", lambda c: re.sub(dates, new, c))(writer)


def rewrite_tokens(content: bytes) -> bytes:
    """Write strings in hexadecimal, numbers with more digits, and other blanks."""
    text = rb"(?<=\[)\((?:[^\\()]|\\.)*\)(?=\]TJ)"
    content = re.sub(text, _hexadecimal, content, flags=re.DOTALL)
    return re.sub(rb"(?<= )(\d+)\.(\d+)(?= [ml] )", rb"\1.\g<2>0 ", content)


def _hexadecimal(match: re.Match[bytes]) -> bytes:
    numbers = {b"n": b"\n", b"r": b"\r", b"t": b"\t", b"b": b"\b", b"f": b"\f"}
    plain = re.sub(
        rb"\\(\d{3}|.)",
        lambda m: bytes([int(m[1], 8)]) if m[1].isdigit() else numbers.get(m[1], m[1]),
        match[0][1:-1], flags=re.DOTALL,
    )  # fmt: skip
    return b"<%s>" % plain.hex().encode()


HONEST: dict[str, Callable[[bytes], bytes]] = {
    "the original": lambda pdf: pdf,
    "saved by pypdf": forged,
    "saved twice": lambda pdf: forged(forged(pdf)),
    "packed by pypdf": lambda pdf: forged(pdf, recompress),
    "content unpacked": lambda pdf: forged(pdf, decompress),
    "producer and dates": lambda pdf: forged(pdf, save_metadata),
    "dates appended": lambda pdf: append_update(pdf, document_info(ModDate="D:20260101000000Z")),
    "content spelt otherwise": lambda pdf: forged(pdf, on_page(1, rewrite_tokens)),
    "an unused object": lambda pdf: forged(pdf, lambda w: w._add_object(dictionary(Eve=N(1)))),
    "another version of Typst": lambda pdf: forged(pdf, document_info(Creator="Typst 0.15.0")),
}


@pytest.mark.parametrize("kind", HONEST)
def test_pdf_comparison_of_resaved_report_finds_no_difference(pdf: bytes, kind: str) -> None:
    made = HONEST[kind](pdf)
    read_report(made, "r.pdf")
    assert compare(made, pdf) == ()


@pytest.mark.parametrize("how", ["plain", "objects", "linearize", "qdf", "normalize"])
def test_pdf_comparison_after_qpdf_finds_no_difference(pdf: bytes, how: str) -> None:
    options: dict[str, dict[str, Any]] = {
        "plain": {}, "linearize": {"linearize": True}, "qdf": {"qdf": True},
        "objects": {"object_stream_mode": pikepdf.ObjectStreamMode.generate},
        "normalize": {"normalize_content": True},
    }  # fmt: skip
    out = io.BytesIO()
    with pikepdf.open(io.BytesIO(pdf)) as document:
        document.save(out, **options[how])
    assert compare(out.getvalue(), pdf) == ()


def shift_operands(by: float, operator: bytes = b"l") -> Edit:
    return lambda content: re.sub(
        rb"([\d.]+) ([\d.]+) %s\b" % operator,
        lambda m: b"%.6f %s %s" % (float(m[1]) + by, m[2], operator),
        content,
    )


@pytest.mark.parametrize(("factor", "equal"), [(0.3, True), (0.99, True), (1.01, False)])
def test_pdf_comparison_ignores_shift_within_tolerance(
    pdf: bytes, factor: float, equal: bool
) -> None:
    made = forged(pdf, on_page(1, shift_operands(factor * COORDINATE_TOLERANCE_PT)))
    assert (compare(made, pdf) == ()) == equal


def test_pdf_comparison_ignores_rounded_last_digit(pdf: bytes) -> None:
    """One number is rounded differently, as on another processor."""
    made = forged(pdf, other_digit)
    asked: list[tuple[str, str]] = []

    def alike(theirs: str, ours: str) -> bool:
        asked.append((theirs, ours))
        return True

    assert compare(made, pdf, alike=alike) == ()
    ((theirs, ours),) = [pair for pair in asked if pair[0] != pair[1]]
    assert is_same_text_up_to_rounding(theirs, ours, lambda *_: True)
    assert not is_same_text_up_to_rounding(theirs, ours, partial(is_same_number_up_to_rounding, ()))
    # the positions of the letters are unchanged
    digit = once(rb"(?<=\))(-?[\d.]+)(?=\()", b"-9000")
    assert compare(forged(made, on_page(1, digit)), made, alike=alike) != ()
    spread = forged(pdf, lambda w: on_page(1, lambda c: spread_text(c, w))(w))
    assert compare(spread, pdf, alike=alike) != ()


# -- limits --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_pdf_comparison_beyond_time_limit_reports_difference(
    pdf: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pages are compared in a separate process."""
    monkeypatch.setattr(pages, "PDF_COMPARISON_TIMEOUT_S", 0.001)
    (found,) = compare(pdf, pdf)
    assert found.is_structural
    assert "could not be compared" in found.what
    monkeypatch.undo()
    assert compare(pdf, pdf) == ()


def test_pdf_comparison_of_damaged_file_raises_no_exception(pdf: bytes) -> None:
    dice = random.Random(1)
    for _ in range(60):
        content = bytearray(pdf)
        for _ in range(dice.randint(1, 40)):
            content[dice.randrange(len(content))] = dice.randrange(256)
        assert isinstance(compare(bytes(content), pdf), tuple)


def test_read_report_pdf_encrypted_with_aes_reports_encryption() -> None:
    """pypdf decrypts AES with a library that px4fuse does not need."""
    writer = PdfWriter(clone_from=REPORT)
    writer.encrypt("", algorithm="RC4-128")
    aes = dictionary(CFM=name("AESV3"), AuthEvent=name("DocOpen"), Length=N(32))
    keys = {key: ByteStringObject(bytes(size)) for key, size in
            {"O": 48, "U": 48, "OE": 32, "UE": 32, "Perms": 16}.items()}  # fmt: skip
    entries = dictionary(V=N(5), R=N(6), Length=N(256), CF=dictionary(StdCF=aes),
                         StmF=name("StdCF"), StrF=name("StdCF"), **keys)  # fmt: skip
    writer._encrypt_entry.update(entries)  # type: ignore[union-attr]
    made = pdf_bytes(writer)
    with pytest.raises(ResultsError, match=r"r\.pdf: the PDF is encrypted\. Hand in"):
        read_report(made, "r.pdf")
