"""Reports forged with care: one thing changed, everything else to the byte as px4fuse wrote it."""

from __future__ import annotations

import io
import re
import zlib
from collections.abc import Callable
from dataclasses import dataclass

from exchange import replace
from pypdf import PdfReader
from pypdf.generic import IndirectObject

from px4fuse.report.seal import sealed

SEAL = re.compile(rb"%px4fuse-sha256 [0-9a-f]{64}\n\Z")


@dataclass(frozen=True)
class Anatomy:
    """A PDF taken apart: what comes before the objects, the objects, and the trailer."""

    head: bytes
    objects: tuple[bytes, ...]
    trailer: bytes
    seal: bytes

    def assembled(self) -> bytes:
        """The file, with a cross-reference table that fits, and no seal."""
        out = bytearray(self.head)
        places = []
        for content in self.objects:
            places.append(len(out))
            out += content
        start = len(out)
        out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(places) + 1)
        for place in places:
            out += b"%010d 00000 n \n" % place
        trailer = re.sub(rb"/Size \d+", b"/Size %d" % (len(places) + 1), self.trailer)
        return bytes(out + re.sub(rb"startxref\n\d+", b"startxref\n%d" % start, trailer))

    def sealed(self) -> bytes:
        """By a forger who knows how reports are sealed."""
        return sealed(self.assembled())

    def unsealed(self) -> bytes:
        """With the seal that the file had."""
        return self.assembled() + self.seal

    def edited(self, number: int, change: Callable[[bytes], bytes]) -> Anatomy:
        """One object changed."""
        objects = list(self.objects)
        before = objects[number - 1]
        objects[number - 1] = change(before)
        assert objects[number - 1] != before, "nothing was forged"
        return replace(self, objects=tuple(objects))

    def streamed(self, number: int, change: Callable[[bytes], bytes]) -> Anatomy:
        """The content of one stream changed, packed as it was."""

        def rewritten(whole: bytes) -> bytes:
            head, _, rest = whole.partition(b">>\nstream\n")
            data = rest[: rest.rindex(b"\nendstream")]
            packed = b"/FlateDecode" in head
            content = zlib.decompress(data) if packed else data
            changed = change(content)
            assert changed != content, "nothing was forged"
            data = zlib.compress(changed) if packed else changed
            head = re.sub(rb"/Length \d+", b"/Length %d" % len(data), head)
            return head + b">>\nstream\n" + data + b"\nendstream\nendobj\n"

        return self.edited(number, rewritten)

    def added(self, content: bytes) -> tuple[Anatomy, int]:
        """One more object, and its number."""
        number = len(self.objects) + 1
        whole = b"%d 0 obj\n%s\nendobj\n" % (number, content)
        return replace(self, objects=(*self.objects, whole)), number


def taken_apart(pdf: bytes) -> Anatomy:
    """A PDF as pypdf writes one."""
    body = SEAL.sub(b"", pdf)
    found = re.search(rb"startxref\n(\d+)\n", body[-64:])
    assert found is not None
    start = int(found[1])
    table, _, trailer = body[start:].partition(b"trailer\n")
    places = [int(line[:10]) for line in table.split(b"\n")[3:-1]]
    ends = [*places[1:], start]
    objects = tuple(body[a:b] for a, b in zip(places, ends, strict=True))
    return Anatomy(body[: places[0]], objects, b"trailer\n" + trailer, pdf[len(body) :])


@dataclass(frozen=True)
class Numbers:
    """Numbers of the objects of a report."""

    pages: tuple[int, ...]
    contents: tuple[int, ...]
    tree: int
    root: int
    info: int
    names: int
    results: int
    resources: int
    fonts: dict[str, int]
    xobjects: int
    states: int


def numbers_of(pdf: bytes) -> Numbers:
    """Where everything is."""
    reader = PdfReader(io.BytesIO(pdf))
    root = reader.trailer["/Root"]

    def number(holder: object, key: str) -> int:
        reference = holder.raw_get(key)  # type: ignore[attr-defined]
        assert isinstance(reference, IndirectObject)
        return reference.idnum

    pages = [page.indirect_reference for page in reader.pages]
    resources = reader.pages[0]["/Resources"]
    file = root["/Names"]["/EmbeddedFiles"]["/Names"][1].get_object()  # type: ignore[index]
    return Numbers(
        pages=tuple(page.idnum for page in pages if page is not None),
        contents=tuple(number(page, "/Contents") for page in reader.pages),
        tree=number(root, "/Pages"),
        root=number(reader.trailer, "/Root"),
        info=number(reader.trailer, "/Info"),
        names=number(root, "/Names"),
        results=number(file["/EF"], "/F"),
        resources=number(reader.pages[0], "/Resources"),
        fonts={name: number(resources["/Font"], name) for name in resources["/Font"]},  # type: ignore[index,attr-defined]
        xobjects=number(resources, "/XObject"),
        states=number(resources, "/ExtGState"),
    )
