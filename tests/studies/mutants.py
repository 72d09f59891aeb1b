"""How many one-operator changes of the package the suite notices.

``python tests/studies/mutants.py --map FOLDER`` runs every test file once by itself under coverage
and keeps in FOLDER which lines it covers and how long it takes. ``python tests/studies/mutants.py
FOLDER --number 300 --seed 1`` then draws changes from the whole package, runs for each the test
files that cover its line (those that cover least first) until one fails, and prints killed and
surviving changes by room, and the survivors. A change that outlives ``--seconds`` of tests counts
as a survivor, one whose line no test covers as uncovered. Nothing in the checkout is changed.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
SWAPPED = {
    ast.Lt: ("<", "<="),
    ast.LtE: ("<=", "<"),
    ast.Gt: (">", ">="),
    ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"),
    ast.In: ("in", "not in"),
    ast.NotIn: ("not in", "in"),
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.Pow: ("**", "*"),
    ast.FloorDiv: ("//", "*"),
    ast.Mod: ("%", "*"),
    ast.And: ("and", "or"),
    ast.Or: ("or", "and"),
}


class Mutant(NamedTuple):
    """One change: characters ``start`` to ``end`` of a file become ``new``."""

    path: str
    line: int
    start: int
    end: int
    new: str

    def text(self, source: str) -> str:
        """Return the file's text with the change."""
        return source[: self.start] + self.new + source[self.end :]

    def told(self) -> str:
        """Return the change in one line, for the table."""
        source = (ROOT / self.path).read_text(encoding="utf-8")
        before = source.splitlines()[self.line - 1].strip()
        after = self.text(source).splitlines()[self.line - 1].strip()
        return f"{self.path}:{self.line}  {before}  ->  {after}"


def mutants(path: Path) -> Iterator[Mutant]:
    """Every one-operator change of a file: operators, numbers, truth values, signs, conditions."""
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
    # zip(..., strict=False) shows only where another mistake was made first
    left_out = {
        id(keyword.value)
        for keyword in ast.walk(tree)
        if isinstance(keyword, ast.keyword) and keyword.arg == "strict"
    }
    for node in ast.walk(tree):
        if id(node) in left_out:
            continue
        match node:
            case ast.Compare(left=left, ops=operators, comparators=others):
                for before, operator, after in zip(
                    [left, *others], operators, others, strict=False
                ):
                    yield from between(before, after, operator)
            case ast.BinOp(left=left, op=operator, right=right):
                yield from between(left, right, operator)
            case ast.BoolOp(op=operator, values=[left, right, *_]):
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
    """A copy of the checkout to change and test in, compiled."""
    kept = ("px4fuse", "tests", "sample_logs", "reports")
    for name in kept:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("pyproject.toml", "README.md", "CHANGELOG.md"):
        shutil.copy2(ROOT / file, folder / file)
    subprocess.run([sys.executable, "-m", "compileall", "-q", str(folder)], check=True)
    return folder


def tested(folder: Path, file: str, *before: str, seconds: float) -> bool:
    """Whether a test file passes in a copy; one that takes too long does not."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, *before, "-m", "pytest", "-n", "0", "-q", "-x", f"tests/{file}"]
    try:
        run = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, timeout=seconds, check=False
        )
    except subprocess.TimeoutExpired:
        return False
    return run.returncode == 0


def make_map(out: Path, workers: int) -> None:
    """Run every test file under coverage and keep its lines and its time in ``out``."""
    from coverage import CoverageData

    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        tree = copied(Path(folder))

        def run(path: Path) -> None:
            data = out / f"{path.stem}.coverage"
            begin = time.monotonic()
            under = ("-m", "coverage", "run", "--source=px4fuse", f"--data-file={data}")
            passed = tested(tree, path.name, *under, seconds=3600)
            measured = CoverageData(str(data))
            measured.read()
            lines = {
                Path(file).relative_to(tree.resolve()).as_posix(): measured.lines(file)
                for file in measured.measured_files()
            }
            data.unlink()
            took = time.monotonic() - begin
            (out / f"{path.stem}.json").write_text(json.dumps({"seconds": took, "lines": lines}))
            print(f"{took:6.1f} s {'passed' if passed else 'FAILED'} {path.name}", flush=True)

        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(run, sorted((ROOT / "tests").glob("test_*.py"))))


def main() -> None:
    """Make the map, or draw, test and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--map", action="store_true")
    parser.add_argument("--number", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    given = parser.parse_args()
    if given.map:
        make_map(given.folder, given.workers)
        return
    coverage = {path.stem: json.loads(path.read_text()) for path in given.folder.glob("*.json")}
    width = {name: sum(map(len, one["lines"].values())) for name, one in coverage.items()}
    every = [one for path in sorted((ROOT / "px4fuse").rglob("*.py")) for one in mutants(path)]
    drawn = random.Random(given.seed).sample(every, given.number)
    verdicts: Counter[tuple[str, str]] = Counter()
    told: list[str] = []
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(given.workers) as pool:
        trees: Queue[Path] = Queue()
        for number in range(given.workers):
            trees.put(copied(Path(folder) / str(number)))

        def judge(mutant: Mutant) -> str:
            names = [
                n for n, one in coverage.items() if mutant.line in one["lines"].get(mutant.path, ())
            ]
            if not names:
                return "uncovered"
            tree = trees.get()
            file = tree / mutant.path
            source = file.read_text(encoding="utf-8")
            file.write_text(mutant.text(source), encoding="utf-8")
            end = time.monotonic() + given.seconds
            try:
                for name in sorted(names, key=width.__getitem__):
                    limit = min(end - time.monotonic(), 30 + 5 * coverage[name]["seconds"])
                    if limit <= 0:
                        break
                    if not tested(tree, f"{name}.py", seconds=limit) and time.monotonic() < end:
                        return "killed"
                return "survived"
            finally:
                file.write_text(source, encoding="utf-8")
                trees.put(tree)

        for mutant, verdict in zip(drawn, pool.map(judge, drawn), strict=True):
            room = mutant.path.split("/")[1]
            verdicts[room, verdict] += 1
            if verdict != "killed":
                told.append(f"{verdict:9} {mutant.told()}")
            print(".", end="", flush=True)
    print(f"\n{'room':22}{'killed':>8}{'survived':>10}{'uncovered':>11}")
    kinds = ("killed", "survived", "uncovered")
    for room in sorted({room for room, _ in verdicts}):
        print(f"{room:22}" + "".join(f"{verdicts[room, kind]:10}" for kind in kinds))
    totals = [sum(n for (_, kind), n in verdicts.items() if kind == wanted) for wanted in kinds]
    print(f"{'all':22}" + "".join(f"{total:10}" for total in totals))
    print("\n".join(told))


if __name__ == "__main__":
    main()
