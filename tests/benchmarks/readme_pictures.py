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

WINDOW = "1360,1010"
REPORTS = REPOSITORY / "reports" / "example"
AISLE = "compare sample_logs/aisle_uwb.ulg"
EVALUATE = "evaluate sample_logs/loop_vio.ulg:vio sample_logs/loop_slam.tum"
DPI, COLOURS, MAX_BYTES = 96, 64, 100_000
# Head and foot of a page (fractions of its height) are cut off; margin (pixels)
HEAD, FOOT, MARGIN = 0.045, 0.965, 12


@dataclass(frozen=True)
class Picture:
    """Picture of a part of a report page, or of the web page of ``explore``.

    Attributes
    ----------
    name : str
        File name without ``.png``.
    command : str
        Arguments of px4fuse.
    page : str
        Text that only the wanted page of the report contains; not used for ``explore``.
    until : float
        Lower edge of the part, as a fraction of the page height.
    """

    name: str
    command: str
    page: str = ""
    until: float = FOOT


PICTURES = (
    Picture("aisle_uwb", AISLE, "EKF2 check: comparison with a two-state", 0.5),
    Picture("explore", "explore sample_logs/aisle_uwb.ulg"),
    Picture("lab_1", AISLE, "Position and velocity along the aisle", 0.585),
    Picture("lab_2", f"{AISLE} --sigma-a 0.001", "Innovations and variances"),
    Picture("lab_3", AISLE, "Difference between KF and EKF2", 0.71),
    Picture("lab_4", "loop sample_logs/loop_vio.ulg", "Loop closure"),
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
            if picture.page in page.get_textpage().get_text_bounded():
                whole = page.render(scale=DPI / 72).to_pil().convert("RGB")
                break
        else:
            raise SystemExit(f"{picture.name}: no page of {picture.command} has {picture.page!r}")
    part = whole.crop((0, int(HEAD * whole.height), whole.width, int(picture.until * whole.height)))
    left, top, right, bottom = ImageChops.invert(part).getbbox() or (0, 0, *part.size)
    return ImageOps.expand(part.crop((left, top, right, bottom)), MARGIN, "white")


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
    size = int(drawn.width * 0.7), int(drawn.height * 0.7)
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
