"""Mutation test: share of one-operator changes of the package that a test detects.

``python tests/studies/mutants.py --map FOLDER`` runs each test file separately under coverage and
writes to FOLDER the lines that each test covers. ``python tests/studies/mutants.py FOLDER --number
300 --seed 1`` then draws changes from the whole package, runs for each the tests that cover its
line (those that cover least first) until one fails, and prints each verdict, and killed and
surviving changes by package. ``--begin 40`` continues a run that was stopped after 40. A change
that survives ``--seconds`` of tests counts as a survivor, one whose line no test covers as
uncovered; changes that no test can detect are listed in :data:`EQUIVALENT` with the reason. The
checkout is not changed.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from queue import Queue
from typing import NamedTuple

import pandas as pd

ROOT = Path(__file__).resolve().parents[2]
SWAPPED = {
    ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"), ast.In: ("in", "not in"), ast.NotIn: ("not in", "in"),
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"),
    ast.Pow: ("**", "*"), ast.FloorDiv: ("//", "*"), ast.Mod: ("%", "*"),
    ast.And: ("and", "or"), ast.Or: ("or", "and"),
}  # fmt: skip

# Changes that no test can detect, by file and part of the changed line
EQUIVALENT = {
    ("px4fuse/ekf2/steps.py", "for column in Columns.POSITION[:3]"):
        "numpy.hypot takes a third array for its output",
    ("px4fuse/filter/hypotheses.py", "1.5e-12 * np.eye("): "below rounding, keeps a matrix regular",
    ("px4fuse/trajectory/graph/covariance.py", "_SINGULAR = 1.5"): "below rounding",
    ("px4fuse/ekf2/replay.py", ">= MAX_S_OFF"): "no double is 0.05 from 1, exactly",
}  # fmt: skip


class Mutant(NamedTuple):
    """Change that replaces characters ``start`` to ``end`` of a file by ``new``."""

    path: str
    line: int
    start: int
    end: int
    new: str

    def text(self, source: str) -> str:
        """Return the file's text with the change."""
        return source[: self.start] + self.new + source[self.end :]

    def describe(self) -> str:
        """Return the change in one line, for the table."""
        source = (ROOT / self.path).read_text(encoding="utf-8")
        before = source.splitlines()[self.line - 1].strip()
        after = self.text(source).splitlines()[self.line - 1].strip()
        return f"{self.path}:{self.line}  {before}  ->  {after}"


def mutants(path: Path) -> Iterator[Mutant]:
    """Yield all one-operator changes of a file: operators, numbers, booleans, signs, conditions."""
    source = path.read_text(encoding="utf-8")
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line.encode()))
    raw = source.encode()
    name = path.relative_to(ROOT).as_posix()

    def offset(line: int, column: int) -> int:
        return len(raw[: starts[line - 1] + column].decode())

    def between(left: ast.expr, right: ast.expr, operator: ast.AST) -> Iterator[Mutant]:
        if type(operator) not in SWAPPED or left.end_lineno is None or left.end_col_offset is None:
            return
        old, new = SWAPPED[type(operator)]
        start = offset(left.end_lineno, left.end_col_offset)
        gap = source[start : offset(right.lineno, right.col_offset)]
        if gap.count(old) == 1:
            at = start + gap.index(old)
            yield Mutant(name, source.count("\n", 0, at) + 1, at, at + len(old), new)

    def replaced(node: ast.expr, new: str) -> Mutant:
        end = offset(node.end_lineno or node.lineno, node.end_col_offset or 0)
        return Mutant(name, node.lineno, offset(node.lineno, node.col_offset), end, new)

    def segment(node: ast.expr) -> str:
        return ast.get_source_segment(source, node) or ""

    tree = ast.parse(source)
    # zip(..., strict=False) has an effect only after another fault
    keywords = (node for node in ast.walk(tree) if isinstance(node, ast.keyword))
    left_out = {id(keyword.value) for keyword in keywords if keyword.arg == "strict"}
    for node in ast.walk(tree):
        if id(node) in left_out:
            continue
        match node:
            case ast.Compare(left=left, ops=operators, comparators=others):
                for one in zip([left, *others], others, operators, strict=False):
                    yield from between(*one)
            case (
                ast.BinOp(left=left, op=operator, right=right)
                | ast.BoolOp(op=operator, values=[left, right, *_])
            ):
                yield from between(left, right, operator)
            case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
                yield replaced(node, segment(operand))
            case ast.Constant(value=bool(value)):
                yield replaced(node, str(not value))
            case ast.Constant(value=int(value)):
                yield replaced(node, str(value + 1))
            case ast.Constant(value=float(value)):
                yield replaced(node, repr(value * 1.5 or 0.1))
            case ast.If(test=condition) | ast.IfExp(test=condition):
                yield replaced(condition, f"(not ({segment(condition)}))")


def copied(folder: Path) -> Path:
    """Make a compiled copy of the checkout, to change and test."""
    kept = ("px4fuse", "tests", "docs", "sample_logs", "reports")
    for name in kept:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("pyproject.toml", "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md",
                 "CITATION.cff", ".ci/run"):  # fmt: skip
        (folder / file).parent.mkdir(exist_ok=True)
        shutil.copy2(ROOT / file, folder / file)
    subprocess.run([sys.executable, "-m", "compileall", "-q", str(folder)], check=True)
    return folder


def passes(folder: Path, *arguments: str, before: Sequence[str] = (), seconds: float) -> bool:
    """Return True if tests pass in a copy within the time limit."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, *before, "-m", "pytest", "-n", "0", "-q", "-x", *arguments]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    try:
        return not subprocess.call(command, cwd=folder, env=environment, timeout=seconds, **quiet)
    except subprocess.TimeoutExpired:
        return False


def make_map(out: Path, workers: int, only: str) -> None:
    """Run each test file under coverage; write to ``out`` the lines that each test covers.

    Lines that run outside a test (imports, fixtures) have the empty name.
    """
    from coverage import CoverageData

    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        tree = copied(Path(folder))
        settings = tree / "coverage.ini"
        settings.write_text("[run]\ndynamic_context = test_function\n")

        def run(path: Path) -> None:
            data = out / f"{path.stem}.coverage"
            begin = time.monotonic()
            under = ("-m", "coverage", "run", f"--rcfile={settings}", "--source=px4fuse",
                     f"--data-file={data}")  # fmt: skip
            passed = passes(tree, f"tests/{path.name}", before=under, seconds=3600)
            measured = CoverageData(str(data))
            measured.read()
            lines: dict[str, dict[str, list[int]]] = {}
            for file in measured.measured_files():
                name = Path(file).relative_to(tree.resolve()).as_posix()
                for line, contexts in measured.contexts_by_lineno(file).items():
                    for context in contexts:
                        test = context.rpartition(".")[2]
                        lines.setdefault(test, {}).setdefault(name, []).append(line)
            data.unlink()
            took = time.monotonic() - begin
            if passed:  # a test that fails without a change would kill every change
                (out / f"{path.stem}.json").write_text(json.dumps({"lines": lines}))
            print(f"{took:6.1f} s {'passed' if passed else 'FAILED'} {path.name}", flush=True)

        with ThreadPoolExecutor(workers) as pool:
            files = sorted((ROOT / "tests").glob("test_*.py"))
            list(pool.map(run, [file for file in files if re.search(only, file.stem)]))


class Cover:
    """Lines covered by each test and fixture."""

    def __init__(self, folder: Path) -> None:
        self.lines: dict[str, dict[str, set[int]]] = {}
        self.fixtures: dict[str, dict[str, set[int]]] = {}
        for path in sorted(folder.glob("*.json")):
            for test, lines in json.loads(path.read_text())["lines"].items():
                file = f"tests/{path.stem}.py"
                into = self.lines if test else self.fixtures
                covered = {name: set(some) for name, some in lines.items()}
                into[f"{file}::{test}" if test else file] = covered
        self.width = {test: sum(map(len, lines.values())) for test, lines in self.lines.items()}

    def of(self, mutant: Mutant) -> list[str]:
        """Return the tests to run for a change, those that cover least first.

        A line that runs while its module is imported is tested by the tests that cover the module
        most, because any test may import it first; a line of a fixture by the whole file.
        """
        path = mutant.path
        covered = (self.lines, self.fixtures)
        tests, files = (
            [n for n, c in of.items() if mutant.line in c.get(path, ())] for of in covered
        )
        first, last = [], files if len(files) < FEW else []
        in_order = sorted(tests, key=self.width.__getitem__)
        if not in_function(path, mutant.line):
            some = [test for test, lines in self.lines.items() if path in lines]
            in_order = sorted(some, key=lambda t: self.width[t] / len(self.lines[t][path]))
            first, last = [RECORDS], []
        # golden tests detect most changes of output, so they follow after the nearest
        kept = [test for test in in_order[NEAREST:] if "test_golden" in test]
        others = [test for test in in_order[NEAREST:] if test not in kept]
        return [*first, *in_order[:NEAREST], *kept, *others, *last]


@cache
def _bodies(path: str) -> list[range]:
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
    return [range(one.body[0].lineno, (one.end_lineno or 0) + 1) for one in functions]


def in_function(path: str, line: int) -> bool:
    """Return True if a line runs when a function is called, not when its module is imported."""
    return any(line in body for body in _bodies(path))


# Examines every class of the package without covering a line
RECORDS = "tests/test_records.py"
# Maximum number of files whose fixtures cover a line; otherwise all files do
FEW = 8
# Number of tests per process, in turn: tests that cover least fail most often
NEAREST = 4
PORTIONS = (NEAREST + 1, 16, 40, 120, 10_000)


def main() -> None:
    """Make the map, or draw changes, test them and print the verdicts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--map", action="store_true")
    parser.add_argument("--number", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--begin", type=int, default=0, help="how many of the draw to pass over")
    parser.add_argument("--seconds", type=float, default=300.0)
    only = "part of the path of the files to change; of the map pattern of its tests"
    parser.add_argument("--only", default="", help=only)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    given = parser.parse_args()
    if given.map:
        make_map(given.folder, given.workers, given.only)
        return
    cover = Cover(given.folder)
    files = [path for path in sorted((ROOT / "px4fuse").rglob("*.py")) if given.only in str(path)]
    every = [one for path in files for one in mutants(path)]
    drawn = random.Random(given.seed).sample(every, min(given.number, len(every)))[given.begin :]
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(given.workers) as pool:
        trees: Queue[Path] = Queue()
        for number in range(given.workers):
            trees.put(copied(Path(folder) / str(number)))

        def judge(mutant: Mutant) -> str:
            names = cover.of(mutant)
            after = mutant.describe().partition("  ->  ")[2]
            if any(mutant.path == path and part in after for path, part in EQUIVALENT):
                return "equivalent"
            if not names:
                return "uncovered"
            if "    >>> " in (ROOT / mutant.path).read_text(encoding="utf-8"):
                names = [mutant.path, *names]
            tree = trees.get()
            file = tree / mutant.path
            source = file.read_text(encoding="utf-8")
            file.write_text(mutant.text(source), encoding="utf-8")
            end = time.monotonic() + given.seconds
            try:
                for portion in PORTIONS:
                    some, names = names[:portion], names[portion:]
                    left = end - time.monotonic()
                    if not some or left <= 0:
                        break
                    if not passes(tree, *some, seconds=left) and time.monotonic() < end:
                        return "killed"
                return "survived"
            finally:
                file.write_text(source, encoding="utf-8")
                trees.put(tree)

        verdicts = []
        for mutant, verdict in zip(drawn, pool.map(judge, drawn), strict=True):
            verdicts.append((mutant.path.split("/")[1], verdict))
            print(f"{verdict:9} {mutant.describe()}", flush=True)
    rooms, kinds = zip(*verdicts, strict=True)
    print(pd.crosstab(pd.Series(rooms, name="room"), pd.Series(kinds, name=""), margins=True))


if __name__ == "__main__":
    main()
