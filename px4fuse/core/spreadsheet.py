"""Protection of spreadsheets from untrusted text that could be executed as a formula."""

import re
import unicodedata

FORMULA_START_CHARACTERS = "=+-@"
# Maximum length (characters) of a table cell; Excel allows 32,767
MAX_CELL_LENGTH = 32_000


def neutralise_formulas(text: str) -> str:
    r"""Escape text so that a spreadsheet does not execute it as a formula (OWASP, CSV injection).

    >>> [neutralise_formulas(text) for text in ("=1+1", " \uff0b1", "a;=1+1", "3 - 2", "-17")]
    ["'=1+1", "' ＋1", "a;'=1+1", '3 - 2', '-17']
    """
    # with some regional settings, Excel splits cells at semicolons
    cells = (f"'{cell}" if _is_formula(cell) else cell for cell in text.split(";"))
    safe_text = "".join(map(_replace_control_character, ";".join(cells)))
    return safe_text if len(safe_text) <= MAX_CELL_LENGTH else safe_text[:MAX_CELL_LENGTH] + "…"


def _is_formula(text: str) -> bool:
    """Return True if the first visible character can begin a formula."""
    if re.fullmatch(r"[+-][0-9]+", text):  # signed integer, for example a student id
        return False
    if text.startswith(("\t", "\r")):
        return True
    for character in text:
        # Unicode categories Z (separators) and C (control characters) are not visible
        if character in "\"'" or unicodedata.category(character)[0] in "ZC":
            continue
        return unicodedata.normalize("NFKC", character)[0] in FORMULA_START_CHARACTERS
    return False


def _replace_control_character(character: str) -> str:
    if unicodedata.category(character) in ("Cc", "Cs", "Zl", "Zp"):
        return " " if character.isspace() else "\N{REPLACEMENT CHARACTER}"
    return character
