"""Texts as they are compared: what looks the same is the same.

Unicode has many letters that look alike (Cyrillic а and Latin a), letters that nobody sees, and
several ways to write one. Which characters look alike is from Unicode's confusables.txt (UTS 39),
as the package confusable-homoglyphs ships it.
"""

from __future__ import annotations

import unicodedata
from functools import cache

from px4fuse.errors import SettingsError

# Letters by their category that print nothing: fillers of Hangul, and a braille cell without dots
INVISIBLE = frozenset("\u115f\u1160\u2800\u3164\uffa0")


def folded(text: str) -> str:
    r"""Text in small letters, each that looks like an ASCII letter or digit as that one.

    Accents and what prints nothing are gone. For comparisons only: folded words of other scripts
    are words of no script.

    >>> folded("Оut\u200blіers, ｎaïve, σ 5 m")  # О and і are Cyrillic
    'outliers, naive, o 5 m'
    """
    return text.casefold() if text.isascii() else "".join(map(_folded, text))


def disguised(text: str) -> bool:
    r"""Whether a word mixes ASCII letters with letters that only look like such, or hides some.

    >>> [disguised(word) for word in ("оutlier", "out\u200blier", "naïve", "выброс", "σ_z")]
    [True, True, False, False, False]
    """
    seen = unicodedata.normalize("NFKD", text)
    latin = [c for c in seen if c.isascii() and c.isalpha()]
    others = [c for c in seen if c.isalpha() and "LATIN" not in unicodedata.name(c, "LATIN")]
    hidden = any(_prints_nothing(c) for c in seen.strip("\ufeff"))
    return len(latin) > 2 and (hidden or any(_folded(c).isascii() for c in others))


def _prints_nothing(character: str) -> bool:
    # soft hyphens and joiners of Arabic and Indic scripts are spelling
    return character in INVISIBLE or (
        unicodedata.category(character) == "Cf" and character not in "\u00ad\u200c\u200d"
    )


@cache
def _folded(character: str) -> str:
    made = []
    for part in unicodedata.normalize("NFKD", character):
        if part in INVISIBLE or unicodedata.category(part) in ("Mn", "Mc", "Me", "Cf"):
            continue
        digit = unicodedata.digit(part, None)
        alike = _alike().get(part, part) if digit is None else str(digit)
        made.append(alike if alike.isascii() else _alike().get(alike.casefold(), alike))
    return "".join(made).casefold()


@cache
def _alike() -> dict[str, str]:
    """Characters to the ASCII letter or digit that they look like, of the same case if there is."""
    try:
        from confusable_homoglyphs.confusables import confusables_data  # noqa: PLC0415 - a megabyte
    except ImportError as error:
        raise SettingsError('grading needs more packages: pip install "px4fuse[grade]".') from error
    made = {}
    for character, listed in confusables_data.items():
        looks = [one["c"] for one in listed if len(one["c"]) == 1]
        looks = [look for look in looks if look.isascii() and look.isalnum()]
        if looks and not character.isascii():
            upper = character.isupper()
            look = min(looks, key=lambda look: (look.isdigit(), look.isupper() != upper, look))
            # the table has one form for capital I and small l
            made[character] = "I" if upper and look == "l" else look
    return made
