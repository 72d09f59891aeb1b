"""Statistics of the class: difficulty and discrimination of each rubric item and fault."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from px4fuse.classroom.grading.model import GradedReport

# Minimum number of reports for the correlation of an item with the other items
MIN_REPORTS_FOR_CORRELATION = 5


@dataclass(frozen=True)
class ItemStatistics:
    """Points of all reports for one rubric item, one part of the answer form, or one fault.

    Attributes
    ----------
    discrimination : float or None
        Correlation between the points for this item and for all other items.
    """

    title: str
    mean_points: float
    max_points: float
    discrimination: float | None


def analyse_items(reports: Sequence[GradedReport]) -> list[ItemStatistics]:
    """Compute points and discrimination of each rubric item, part of the answer form, and fault."""
    item_scores, form_scores, fault_scores = (
        defaultdict[str, list[tuple[float, float, float]]](list) for _ in range(3)
    )
    for report in reports:
        if report.instructor_action:
            continue
        for prefix, items, scores_by_title in (
            ("", report.items, item_scores),
            ("Answer form: ", report.form_part_scores, form_scores),
        ):
            total_points = sum(item.points for item in items)
            for item in items:
                if not item.is_awaiting_points:
                    scores_by_title[f"{prefix}{item.title}"].append(
                        (item.points, item.max_points, total_points - item.points)
                    )
        for kind, is_named in report.did_student_name_fault.items():
            fault_scores[f"Fault: {kind}"].append((float(is_named), 1.0, report.points))
    statistics = []
    for title, scores in (item_scores | form_scores | fault_scores).items():
        points, max_points, other_points = np.transpose(scores)
        discrimination = None
        has_variation = np.ptp(points) > 0.0 and np.ptp(other_points) > 0.0
        if len(scores) >= MIN_REPORTS_FOR_CORRELATION and has_variation:
            discrimination = float(np.corrcoef(points, other_points)[0, 1])
        statistics.append(
            ItemStatistics(title, float(points.mean()), float(max_points.max()), discrimination)
        )
    return statistics
