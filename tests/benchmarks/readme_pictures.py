"""Make the pictures of README from the pages that its commands write.

    python tests/benchmarks/readme_pictures.py

It takes a minute, needs Chromium, and writes
``reports/example/*.png``: the part of a page named below, on a palette, below 100 kB each.
"""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import pypdfium2
from PIL import Image, ImageChops, ImageOps

from px4fuse.cli import cli

REPOSITORY = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(REPOSITORY / "tests"))

from browser import BROWSERS  # noqa: E402 - module of the tests

WINDOW = "1360,880"
REPORTS = REPOSITORY / "reports" / "example"
AISLE = "compare sample_logs/aisle_uwb.ulg"
SMALL_Q = f"{AISLE} --sigma-a 0.001"
EVALUATE = "evaluate sample_logs/loop_vio.ulg:vio sample_logs/loop_slam.tum"
DPI, COLOURS, MAX_BYTES = 96, 64, 100_000
# Fractions of the height of a page: its foot, and the free space above a text
FOOT, GAP = 0.965, 0.004
MARGIN = 12  # pixels


@dataclass(frozen=True)
class Picture:
    """Picture of a part of a report page, or of the web page of ``explore``.

    Attributes
    ----------
    name : str
        File name without ``.png``.
    command : str
        Arguments of px4fuse.
    first : str
        Text at the upper edge; the page is the first one with it. Not used for ``explore``.
    end : str
        Text below the lower edge; empty for the foot of the page.
    """

    name: str
    command: str
    first: str = ""
    end: str = ""


PICTURES = (
    Picture("aisle_uwb", AISLE, "aisle_uwb.ulg"),
    Picture("explore", "explore sample_logs/aisle_uwb.ulg"),
    Picture("lab_1", AISLE, "Position and velocity along the axis of largest motion"),
    Picture("lab_2", SMALL_Q, "Innovations and variances along"),
    Picture("lab_3", AISLE, "Difference between KF and EKF2, setting"),
    Picture("lab_4", "loop sample_logs/loop_vio.ulg", "Loop closure", "Loop closures and RPE"),
    Picture("lab_5", EVALUATE, "Trajectory error"),
)


def made(picture: Picture, folder: Path) -> Image.Image:
    """Draw the picture in full colour; each report is made once."""
    stem = picture.command.replace("/", "_").replace(" ", "_").replace(":", "_")
    report = folder / f"{stem}.pdf"
    words = shlex.split(picture.command)
    if words[0] == "explore":
        return screenshot(words, folder)
    if not report.exists():
        run([*words, "-o", str(report)])
    with pypdfium2.PdfDocument(report) as document:
        for page in document:
            top = distance_from_top(page, picture.first)
            bottom = distance_from_top(page, picture.end) if picture.end else FOOT
            if top is not None and bottom is not None:
                whole = page.render(scale=DPI / 72).to_pil().convert("RGB")
                break
        else:
            raise SystemExit(f"{picture.name}: no page of {picture.command} has {picture.first!r}")
    edges = 0, int((top - GAP) * whole.height), whole.width, int((bottom - GAP) * whole.height)
    part = whole.crop(edges)
    content = ImageChops.invert(part).getbbox()
    return ImageOps.expand(part.crop(content), MARGIN, "white")


def distance_from_top(page: pypdfium2.PdfPage, text: str) -> float | None:
    """Return the distance of a text from the top of its page, as a fraction of the height."""
    characters = page.get_textpage()
    found = characters.search(text, match_case=True).get_next()
    if found is None:
        return None
    upper_edge = max(characters.get_charbox(found[0] + i)[3] for i in range(found[1]))
    return float(1.0 - upper_edge / page.get_height())


def screenshot(words: list[str], folder: Path) -> Image.Image:
    """Take a picture of the first screen of a web page."""
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        raise SystemExit("A picture of a web page requires Chromium on the path.")
    page, target = folder / "page.html", folder / "page.png"
    run([*words, "-o", str(page)])
    subprocess.run(
        [
            browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
            "--virtual-time-budget=10000", f"--window-size={WINDOW}", f"--screenshot={target}",
            page.as_uri(),
        ],
        check=True, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    with Image.open(target) as drawn:
        return smaller(drawn)


def smaller(drawn: Image.Image) -> Image.Image:
    """Scale a picture to the common width."""
    size = int(drawn.width * 0.66), int(drawn.height * 0.66)
    return drawn.convert("RGB").resize(size, Image.Resampling.LANCZOS)


def run(words: list[str]) -> None:
    """Run a px4fuse command."""
    cli.main(words, standalone_mode=False)


def main() -> None:
    """Write every picture and print its size."""
    with tempfile.TemporaryDirectory() as folder:
        for picture in PICTURES:
            target = REPORTS / f"{picture.name}.png"
            made(picture, Path(folder)).quantize(COLOURS).save(target, optimize=True)
            size = target.stat().st_size
            print(f"{target.name}: {size:,} bytes")
            if size > MAX_BYTES:
                raise SystemExit(f"{target.name} is larger than {MAX_BYTES:,} bytes.")


if __name__ == "__main__":
    main()
