"""Statistics of the class: difficulty and discrimination of each rubric item and fault."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from px4fuse.classroom.grading.model import GradedReport

# Minimum number of reports for the correlation of an item with the other items
MIN_REPORTS_FOR_CORRELATION = 5
ITEM_STATISTICS_TITLES = ("item", "reports", "mean_fraction", "discrimination", "without_points")


@dataclass(frozen=True)
class ItemStatistics:
    """Points of all reports for one rubric item, one part of the answer form, or one fault.

    Attributes
    ----------
    point_fractions : tuple of float
        Points of each report, divided by the maximum points.
    discrimination : float or None
        Correlation between the points for this item and for all other items.
    """

    title: str
    point_fractions: tuple[float, ...]
    max_points: float
    discrimination: float | None

    @property
    def csv_row(self) -> tuple[str | float | None, ...]:
        """Cells of the row of ``items.csv``, in the order of ITEM_STATISTICS_TITLES."""
        return (
            self.title,
            len(self.point_fractions),
            round(float(np.mean(self.point_fractions)), 3),
            self.discrimination,
            self.point_fractions.count(0.0),
        )


def analyse_items(reports: Sequence[GradedReport]) -> list[ItemStatistics]:
    """Compute points and discrimination of each rubric item, part of the answer form, and fault."""
    scores_by_item: dict[tuple[int, str], list[tuple[float, float, float]]] = defaultdict(list)
    for report in reports:
        if report.instructor_action:
            continue
        for group_index, prefix, items in (
            (0, "", report.items),
            (1, "Answer form: ", report.form_part_scores),
        ):
            total_points = sum(item.points for item in items)
            for item in items:
                if item.is_awaiting_points:
                    continue
                score = item.points, item.max_points, total_points - item.points
                scores_by_item[group_index, f"{prefix}{item.title}"].append(score)
        for kind, is_named in report.did_student_name_fault.items():
            scores_by_item[2, f"Fault: {kind}"].append((float(is_named), 1.0, report.points))
    statistics = []
    for (_, title), scores in sorted(scores_by_item.items(), key=lambda item: item[0][0]):
        item_points, max_points, points_of_other_items = np.transpose(scores)
        discrimination = None
        if (
            len(scores) >= MIN_REPORTS_FOR_CORRELATION
            and np.ptp(item_points)
            and np.ptp(points_of_other_items)
        ):
            discrimination = round(float(np.corrcoef(item_points, points_of_other_items)[0, 1]), 2)
        point_fractions = item_points / np.where(max_points > 0.0, max_points, 1.0)
        statistics.append(
            ItemStatistics(
                title, tuple(point_fractions.tolist()), float(max(max_points)), discrimination
            )
        )
    return statistics
