"""Text of strangers in tables for spreadsheets, where none of it is run as a formula."""

import re
import unicodedata

FORMULA = "=+-@"
# Excel cuts off at 32,767 characters
MAX_CHARACTERS = 32_000


def neutral(text: str) -> str:
    r"""Text that a spreadsheet shows as text, after OWASP's advice on CSV injection.

    >>> neutral("=1+1"), neutral(" \uff0b1"), neutral("a;=1+1"), neutral("3 - 2")
    ("'=1+1", "' ＋1", "a;'=1+1", '3 - 2')
    """
    # Where the computer's region says so, Excel splits at semicolons instead, even within quotes
    parts = (f"'{part}" if _is_formula(part) else part for part in text.split(";"))
    safe = "".join(map(_fit, ";".join(parts)))
    return safe if len(safe) <= MAX_CHARACTERS else safe[:MAX_CHARACTERS] + "…"


def neutral_id(text: str) -> str:
    """An id as it is where a spreadsheet cannot take it for a formula, else :func:`neutral`.

    >>> neutral_id("0042"), neutral_id("-17"), neutral_id("a.b@c.de"), neutral_id("=1")
    ('0042', '-17', 'a.b@c.de', "'=1")
    """
    return text if re.fullmatch(r"[+-]\d+|\w[\w.@+-]*", text) else neutral(text)


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


def _fit(character: str) -> str:
    if unicodedata.category(character) in ("Cc", "Cs", "Zl", "Zp"):
        return " " if character.isspace() else "\N{REPLACEMENT CHARACTER}"
    return character
