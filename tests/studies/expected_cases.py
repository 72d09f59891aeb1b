"""Compare the findings of px4fuse with the expected findings of a folder of cases.

``expected_cases.py [FOLDER] [--kind KIND ...] [--case NAME ...]`` runs the command of each case in
``FOLDER/EXPECTED.json`` (default: ``../shared/cases``) and prints one line per case: the result,
the first finding, and everything that must not be printed. It ends with a count per result:

- correct: the first finding of severity warning or error is the expected one
- later: the expected finding exists, but another one precedes it
- wrong: another finding, or a finding of a clean case
- none: no finding
- harmful (in addition): a finding or an action that must not be printed

``../shared/cases/reports`` has its cases in a list. ``report_cases.toml`` contains the expressions
that their output must and must not contain; a case is half if the output contains only some.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
REPORT_CASES = Path(__file__).with_name("report_cases.toml")
TIMEOUT_S = 300.0
Finding = dict[str, Any]


def run(command: list[str], folder: Path) -> list[Finding]:
    """Run px4fuse; return its findings, a refusal as one finding of severity error."""
    done = subprocess.run(
        [sys.executable, "-m", "px4fuse", *command, "--json", "-"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    try:
        findings: list[Finding] = json.loads(done.stdout)["findings"]
    except (json.JSONDecodeError, KeyError):
        text = done.stderr.strip()
        return [
            {"id": "refusal", "severity": "error", "message": text, "remedy": text, "spans_s": []}
        ]
    return findings


def text_of(finding: Finding) -> str:
    return f"{finding['message']} {finding['remedy']}"


def numbers(text: str, unit: str) -> list[float]:
    """Return the numbers of a text that are followed by a unit; without a unit, all numbers."""
    plain = text.replace("−", "-").replace(",", "")
    suffix = rf"\s*{re.escape(unit.strip())}(?!\w)" if unit.strip() else ""
    return [float(number) for number in re.findall(rf"([+-]?\d+(?:\.\d+)?){suffix}", plain)]


def has_number(text: str, expected: Finding, prefix: str = "") -> bool:
    value, unit = expected[f"{prefix}value"], expected.get(f"{prefix}unit", "")
    limit = expected.get(f"{prefix}within", 0.0) + 1e-9
    return any(abs(abs(number) - abs(value)) <= limit for number in numbers(text, unit))


def is_expected(finding: Finding, expected: Finding) -> bool:
    """Return True if a finding contains the expected words, number, times and action."""
    text = text_of(finding)
    for group in expected.get("says", []):
        if not any(re.search(words, text, re.IGNORECASE) for words in group):
            return False
    alternatives = [prefix for prefix in ("", "or_") if f"{prefix}value" in expected]
    if alternatives and not any(has_number(text, expected, prefix) for prefix in alternatives):
        return False
    if not all(re.search(words, finding["remedy"]) for words in expected.get("fix", [])):
        return False
    limit = expected.get("within", 0.5) if "value" not in expected else 0.5
    times = [*numbers(text, " s"), *(time for span in finding["spans_s"] for time in span)]
    return all(
        any(abs(time - edge) <= limit for time in times)
        for span in expected.get("spans_s", [])
        for edge in span
    )


def judge(case: Finding, findings: list[Finding]) -> tuple[str, Finding | None, list[str]]:
    """Return the result, the first finding that counts, and the forbidden expressions found."""
    harmful = [
        forbidden["words"]
        for forbidden in case["must_not"]
        if any(re.search(forbidden["words"], text_of(one)) for one in findings)
    ]
    relevant = [
        one
        for one in findings
        if one["severity"] in ("warning", "error")
        and not any(re.search(words, text_of(one)) for words in case["may_precede"])
    ]
    expected, first = case["first_finding"], relevant[0] if relevant else None
    if expected is None:
        return ("correct" if first is None else "wrong"), first, harmful
    if any(is_expected(one, expected) for one in relevant[:1]):
        return "correct", first, harmful
    if any(is_expected(one, expected) for one in findings):
        return "later", first, harmful
    return ("none" if first is None else "wrong"), first, harmful


def output(command: str, folder: Path) -> str:
    """Run the commands of a report case; return all texts of their output, one per line."""
    texts = []
    for part in command.split(";"):
        arguments = part.split()[1:]
        with tempfile.TemporaryDirectory() as made:
            files = {"evaluate": ["-o", f"{made}/report.pdf"], "compare": ["--json", "-"]}
            arguments = [word.replace("out.json", f"{made}/out.json") for word in arguments]
            done = subprocess.run(
                [sys.executable, "-m", "px4fuse", *arguments, *files.get(arguments[0], [])],
                cwd=folder,
                env=os.environ | {"PYTHONPATH": str(ROOT)},
                capture_output=True,
                text=True,
                timeout=TIMEOUT_S,
                check=False,
            )
        text = done.stdout
        if arguments[0] == "compare" and text.strip():
            results = json.loads(text)
            card = results.get("card", {})
            card_texts = [card.get("effect_text"), card.get("reconcile"), card.get("identity")]
            texts += [*map(text_of, results["findings"]), *map(str, card_texts)]
            text = ""
        texts += [text, done.stderr]
    return "\n".join(texts)


def check_reports(folder: Path, cases: list[Finding], names: list[str]) -> None:
    """Print the result of each report case: the missing and the forbidden expressions."""
    expected, counts = tomllib.loads(REPORT_CASES.read_text()), Counter[str]()
    for case in cases:
        name = case["file"]
        if names and not any(part in name for part in names):
            continue
        text = output(case["command"].replace("{file}", name), folder)
        says = expected[name]["says"]
        missing = [words for words in says if not re.search(words, text)]
        never = [*map(re.escape, case["must_not_say"]), *expected[name].get("never", [])]
        forbidden = [words for words in never if re.search(words, text)]
        result = "correct" if not missing else "half" if len(missing) < len(says) else "none"
        if not missing and forbidden:
            result = "half"
        counts.update([result, *(["harmful"] if forbidden else [])])
        print(f"{result:8s} {name}", flush=True)
        for label, words in (("missing", missing), ("harmful", forbidden)):
            for word in words:
                print(f"    {label}: {word}", flush=True)
    print(dict(counts))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT.parent / "shared" / "cases")
    parser.add_argument("--kind", nargs="+", default=[])
    parser.add_argument("--case", nargs="+", default=[])
    options = parser.parse_args()
    cases = json.loads((options.folder / "EXPECTED.json").read_text())["cases"]
    if isinstance(cases, list):
        check_reports(options.folder, cases, options.case)
        return
    counts: Counter[str] = Counter()
    for name, case in cases.items():
        if (options.kind and case["kind"] not in options.kind) or (
            options.case and name not in options.case
        ):
            continue
        result, first, harmful = judge(case, run(case["command"], options.folder))
        counts.update([result, *(["harmful"] if harmful else [])])
        shown = "no finding" if first is None else f"{first['id']}: {text_of(first)[:240]}"
        print(f"{result:8s} {case['kind']:11s} {name:18s} {shown}", flush=True)
        for words in harmful:
            print(f"    harmful: {words}", flush=True)
    print(dict(counts))


if __name__ == "__main__":
    main()
