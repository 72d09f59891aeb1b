"""A fleet's table as JUnit XML: a test case per log, for what shows the tests of a vehicle."""

from collections import Counter
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
    for _, rows in table.groupby("log", sort=False):
        first = rows.iloc[0]
        known = cleaned(first["vehicle"] or first["hardware"] or SUITE)
        case = SubElement(
            suite, "testcase", classname=known, name=cleaned(first["log"]), time="0"
        )  # fmt: skip
        changes = rows.loc[rows["change"] != "", ["axis", "change"]].to_numpy()
        worse = [": ".join(filter(None, each)) for each in changes]
        reason = cleaned(". ".join(filter(None, (first["reason"], first["remedy"]))))
        if worse or first["status"] == FAILED:
            text = cleaned("\n".join(worse)) or reason
            failure = SubElement(
                case, "failure", type="worse" if worse else FAILED, message=text.splitlines()[0]
            )
            failure.text = text
        elif (rows["status"] == NOT_JUDGED).all():
            SubElement(case, "skipped", message=reason)
    counts = Counter(child.tag for case in suite for child in case)
    for element in (root, suite):
        element.set("tests", str(len(suite)))
        element.set("failures", str(counts["failure"]))
        element.set("errors", "0")
    suite.set("skipped", str(counts["skipped"]))
    indent(root)
    written: bytes = tostring(root, encoding="utf-8", xml_declaration=True)
    return written + b"\n"
