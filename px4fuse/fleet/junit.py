"""A fleet's table as JUnit XML: a test case per log, for what shows the tests of a vehicle."""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement, indent, tostring

import pandas as pd

from px4fuse.fleet.rows import FAILED, NOT_JUDGED
from px4fuse.results.reading import cleaned

SUITE = "px4fuse batch"


def junit(table: pd.DataFrame) -> bytes:
    """The table as JUnit XML: a log that is worse than before, or that failed, is a failure.

    Parameters
    ----------
    table : DataFrame
        As :func:`px4fuse.batch` gives it.
    """
    root = Element("testsuites")
    suite = SubElement(root, "testsuite", name=SUITE)
    counts = {"tests": 0, "failures": 0, "errors": 0, "skipped": 0}
    for _, rows in table.groupby("log", sort=False):
        first = rows.iloc[0]
        case = SubElement(
            suite,
            "testcase",
            classname=cleaned(first["vehicle"] or first["hardware"] or SUITE),
            name=cleaned(first["log"]),
            time="0",
        )
        counts["tests"] += 1
        worse = [
            f"{axis}: {change}" if axis else change
            for axis, change in zip(rows["axis"], rows["change"], strict=True)
            if change
        ]
        reason = cleaned(". ".join(filter(None, (first["reason"], first["remedy"]))))
        if worse or first["status"] == FAILED:
            kind = "worse" if worse else FAILED
            text = cleaned("\n".join(worse)) or reason
            failure = SubElement(case, "failure", type=kind, message=text.splitlines()[0])
            failure.text = text
            counts["failures"] += 1
        elif (rows["status"] == NOT_JUDGED).all():
            SubElement(case, "skipped", message=reason)
            counts["skipped"] += 1
    for element in (root, suite):
        for name, count in counts.items():
            # of the whole, the schema knows no skipped
            if element is suite or name != "skipped":
                element.set(name, str(count))
    indent(root)
    written: bytes = tostring(root, encoding="utf-8", xml_declaration=True)
    return written + b"\n"
