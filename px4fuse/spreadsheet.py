"""Text of strangers in tables for spreadsheets, where none of it is run as a formula."""

import re
import unicodedata

FORMULA = "=+-@"
# Excel cuts off at 32,767 characters
MAX_CHARACTERS = 32_000


def neutralise_formulas(text: str) -> str:
    r"""Text that a spreadsheet shows as text, after OWASP's advice on CSV injection.

    >>> neutralise_formulas("=1+1"), neutralise_formulas(" \uff0b1"), neutralise_formulas("a;=1+1"), neutralise_formulas("3 - 2")
    ("'=1+1", "' ＋1", "a;'=1+1", '3 - 2')
    """
    # Where the computer's region says so, Excel splits at semicolons instead, even within quotes
    cells = (f"'{cell}" if _is_formula(cell) else cell for cell in text.split(";"))
    safe_text = "".join(map(_replace_control_character, ";".join(cells)))
    return safe_text if len(safe_text) <= MAX_CHARACTERS else safe_text[:MAX_CHARACTERS] + "…"


def neutralise_id(text: str) -> str:
    """An id as it is where a spreadsheet cannot take it for a formula, else :func:`neutralise_formulas`.

    >>> neutralise_id("0042"), neutralise_id("-17"), neutralise_id("a.b@c.de"), neutralise_id("=1")
    ('0042', '-17', 'a.b@c.de', "'=1")
    """
    return text if re.fullmatch(r"[+-]\d+|\w[\w.@+-]*", text) else neutralise_formulas(text)


def _is_formula(text: str) -> bool:
    """Whether its first visible character, quotes passed over, may begin a formula."""
    if text.startswith(("\t", "\r")):
        return True
    for character in text:
        # Separators, controls, formatting characters, surrogates
        if character in "\"'" or unicodedata.category(character)[0] in "ZC":
            continue
        return unicodedata.normalize("NFKC", character)[0] in FORMULA
    return False


def _replace_control_character(character: str) -> str:
    if unicodedata.category(character) in ("Cc", "Cs", "Zl", "Zp"):
        return " " if character.isspace() else "\N{REPLACEMENT CHARACTER}"
    return character
