"""Notes as students write them: honest ones in ten languages, and what only fills a page."""

from pathlib import Path

_FOLDER = Path(__file__).parent / "notes"
HONEST = {path.stem: path.read_text(encoding="utf-8") for path in sorted(_FOLDER.glob("*.md"))}
FILLER = {path.stem: path.read_text(encoding="utf-8") for path in sorted(_FOLDER.glob("*/*.md"))}
ENGLISH = HONEST["english"]
