"""Questions that an instructor can ask a student about the submitted report."""

import textwrap
from collections.abc import Iterator, Sequence

from px4fuse.core.text import shorten_to_line
from px4fuse.results.answer_form import FAULT_KINDS, NO_FAULT_KIND, REPORT_PANELS, Answers

from ..assignment.key import AnswerKey, CorrectFormAnswers
from .form_points import (
    describe_right_answer,
    find_panels_showing_fault,
    list_answered_choices,
)
from .model import Grade

# Question to the student, and expected answer
QuestionAndAnswer = tuple[str, str]


def format_questions(grades: Sequence[Grade], key: AnswerKey, count: int) -> str:
    """Format ``count`` questions and their right answers for each student with an answer form."""
    lines = [f"Questions for an oral examination: {count} per student, with the expected answers."]
    for grade in grades:
        report = grade.counted_report
        answer = key.find_answers_by_log_sha256(report.log_sha256) if report else None
        if report is None or report.form is None or answer is None or answer.form is None:
            continue
        lines += ["", shorten_to_line(f"{grade.display_name} {grade.student_id}", 100)]
        questions = [*ask_about_form(report.form, answer.form)][:count]
        for number, (question, expected) in enumerate(questions, start=1):
            for prefix, text in ((f"{number}. ", question), ("   Expected: ", expected)):
                lines += textwrap.wrap(text, 96, initial_indent=prefix, subsequent_indent="   ")
    return "\n".join(lines) + "\n"


def ask_about_form(
    answers: Answers, right_answers: CorrectFormAnswers
) -> Iterator[QuestionAndAnswer]:
    """Yield questions for an oral exam about a student's answer form, with the expected answers.

    Order: faults that the student named but the flight does not have, injected faults, and
    multiple-choice questions on plots (wrong answers first).
    """
    kinds_named_by_student = [fault.kind for fault in answers.mistakes]
    injected_fault_kinds = [fault.kind for fault in right_answers.mistakes]
    for kind in kinds_named_by_student:
        if kind not in (*injected_fault_kinds, NO_FAULT_KIND):
            yield (
                f"You named {kind} ({FAULT_KINDS[kind].description}). Which plot would show this "
                "fault? Does your report show the fault in this plot?",
                f"{kind} would be visible in {' or '.join(find_panels_showing_fault(kind))}. "
                f"Injected fault of the flight: {', '.join(injected_fault_kinds) or 'no fault'}.",
            )
    for fault in right_answers.mistakes:
        description = FAULT_KINDS[fault.kind].description
        if fault.kind not in kinds_named_by_student:
            yield (
                f"Your flight also has this fault: {description}. Show this fault in a plot of "
                "your report. State size and time of the fault.",
                f"{describe_right_answer(fault)}.",
            )
            continue
        panels = find_panels_showing_fault(fault.kind)
        other_panels = [panel for panel in REPORT_PANELS if panel not in panels]
        yield (
            f"You named {fault.kind} ({description}). Show this fault in a plot of your report. "
            "Name a plot that cannot show this fault, with the reason.",
            f"{describe_right_answer(fault)}. Examples of plots that cannot show {fault.kind}: "
            f"{' or '.join(other_panels[:2])}.",
        )
    wrong_answers_first = sorted(
        list_answered_choices(answers, right_answers),
        key=lambda each: each.letter == each.right_letter,
    )
    for choice, right_letter, letter in wrong_answers_first:
        answer_text = choice.answer_text(letter) or "none"
        yield (
            f"{choice.question}. Your answer: {answer_text}. Explain this answer with the figure.",
            f"Right: {choice.answer_text(right_letter)}.",
        )
