"""Language of all texts: rejected phrases, and the first words of docstrings (docs/style.md)."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

REPOSITORY = Path(__file__).parent.parent
PACKAGE = REPOSITORY / "px4fuse"
# First words that announce a subordinate clause instead of an imperative or a noun phrase
CLAUSE = re.compile(r"(What|Whether|How|Whose|Which|Of|Where|Why|That|The same)\b")
# Places that quote a phrase, with the reason
QUOTATIONS = {
    "docs/style.md": "states the rules with the rejected phrases",
    "docs/glossary.md": "lists the words that users search for",
}
# Lines that quote a phrase, by a part of the line
EXCEPTIONS = {
    "time,timestamp,stamp": "column names of position files",
    'stamp = "usec"': "field of a table of MAVLink messages",
    "``stamp`` the": "the same field in its docstring",
    "WANDER BIAS IMU": "names of random streams, which determine simulated flights",
}


class Phrase(NamedTuple):
    """Rejected phrase with the alternative; ``in_code``: also in docstrings and comments."""

    pattern: re.Pattern[str]
    in_code: bool
    alternative: str


def read_phrases() -> list[Phrase]:
    """Read rejected_phrases.txt."""
    lines = Path(__file__).with_name("rejected_phrases.txt").read_text("utf-8").splitlines()
    rows = [re.split(r"  +", line, maxsplit=2) for line in lines if line and line[0] != "#"]
    return [Phrase(re.compile(row[0], re.IGNORECASE), row[1] == "A", row[2]) for row in rows]


PHRASES = read_phrases()


def docstrings(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Yield all docstrings with their line."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for node in ast.walk(tree):
        if isinstance(node, kinds) and (text := ast.get_docstring(node)):
            yield text, getattr(node, "lineno", 1)


def comments(source: str) -> Iterator[tuple[str, int]]:
    """Yield all comments with their line."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.string.lstrip("# "), token.start[0]


def literals(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Yield the string literals that are sentences: with a blank and two words."""
    documentation = {text for text, _ in docstrings(tree)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            text = node.value
            if (
                re.search(r"\w\w+ \w\w+", text)
                and ast.unparse(node)
                and not is_docstring(text, documentation)
            ):
                yield text, node.lineno


def is_docstring(text: str, documentation: set[str]) -> bool:
    """Return True if a literal is one of the docstrings."""
    return any(text.strip().startswith(each[:60]) for each in documentation if each)


def texts_of_python(path: Path) -> Iterator[tuple[str, int, bool]]:
    """Yield text, line and True for docstrings and comments of a module."""
    source = path.read_text("utf-8")
    tree = ast.parse(source)
    for text, line in literals(tree):
        yield text, line, False
    for text, line in (*docstrings(tree), *comments(source)):
        yield text, line, True


def texts_of_document(path: Path) -> Iterator[tuple[str, int, bool]]:
    """Yield the lines of a document or template without code."""
    is_code = False
    for number, line in enumerate(path.read_text("utf-8").splitlines(), 1):
        is_code ^= line.startswith("```")
        if not is_code:
            yield re.sub(r"`[^`]*`", "", line), number, False


def all_texts() -> Iterator[tuple[str, str, int, bool]]:
    """Yield file, text, line, and True for docstrings and comments."""
    documents = [*REPOSITORY.glob("*.md"), *REPOSITORY.glob("docs/*.md"), *PACKAGE.rglob("*.toml")]
    templates = [*PACKAGE.rglob("*.html"), *PACKAGE.rglob("*.typ")]
    for path in (*documents, *templates):
        for text, line, in_code in texts_of_document(path):
            yield path.relative_to(REPOSITORY).as_posix(), text, line, in_code
    for path in PACKAGE.rglob("*.py"):
        for text, line, in_code in texts_of_python(path):
            yield path.relative_to(REPOSITORY).as_posix(), text, line, in_code


def test_documentation_and_messages_contain_no_banned_phrase() -> None:
    hits = [
        f"{name}:{line}: {match[0]!r} -> {phrase.alternative}"
        for name, text, line, in_code in all_texts()
        if name not in QUOTATIONS
        for phrase in PHRASES
        if phrase.in_code or not in_code
        if (match := phrase.pattern.search(text)) and not any(each in text for each in EXCEPTIONS)
    ]
    assert hits == []


def test_docstrings_begin_with_an_imperative_or_noun() -> None:
    hits = [
        f"{path.relative_to(REPOSITORY)}:{line}: {text.splitlines()[0]}"
        for folder in (PACKAGE, REPOSITORY / "tests")
        for path in folder.rglob("*.py")
        for text, line in docstrings(ast.parse(path.read_text("utf-8")))
        if CLAUSE.match(text)
    ]
    assert hits == []


@pytest.mark.parametrize(
    ("text", "is_rejected"),
    [
        ("The two filters are 3 cm apart.", True),
        ("The filter is too sure of itself", True),
        ("errors against ground truth", False),
    ],
)
def test_banned_phrase_patterns_match_their_examples(text: str, is_rejected: bool) -> None:
    assert any(phrase.pattern.search(text) for phrase in PHRASES) == is_rejected
