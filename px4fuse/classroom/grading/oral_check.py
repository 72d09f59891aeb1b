"""Questions for an oral check of a student, about the student's answer form and flight."""

import textwrap
from collections.abc import Iterator, Sequence

from px4fuse.classroom.assignment.key import AnswerKey
from px4fuse.classroom.assignment.truth import FormTruth
from px4fuse.classroom.grading.form_points import describe_right_answer, panels_showing
from px4fuse.classroom.grading.model import Entry
from px4fuse.core.text import one_line
from px4fuse.results.answer_form import FAULT_KINDS, NO_FAULT_KIND, PANELS, Answers

# Question to the student, and the answer that the instructor can expect
Question = tuple[str, str]


def questions_text(entries: Sequence[Entry], key: AnswerKey, count: int) -> str:
    """Format questions and expected answers for each student with an answer form."""
    lines = [f"Questions for an oral check: {count} per student, with the expected answers."]
    for entry in entries:
        report = entry.counted_report
        answer = key.of_log(report.log_sha256) if report else None
        if report is None or report.form is None or answer is None or answer.form is None:
            continue
        lines += ["", one_line(f"{entry.display_name} {entry.student_id}", 100)]
        questions = [*ask_about_form(report.form, answer.form)][:count]
        for number, (question, expected) in enumerate(questions, start=1):
            for prefix, text in ((f"{number}. ", question), ("   Expected: ", expected)):
                lines += textwrap.wrap(text, 96, initial_indent=prefix, subsequent_indent="   ")
    return "\n".join(lines) + "\n"


def ask_about_form(form: Answers, truth: FormTruth) -> Iterator[Question]:
    """Yield questions about the faults in a form, then about the figures, wrong answers first."""
    named_kinds = [fault.kind for fault in form.mistakes]
    true_kinds = [fault.kind for fault in truth.mistakes]
    flight_text = ", ".join(true_kinds) or "no fault"
    for kind in named_kinds:
        if kind in (*true_kinds, NO_FAULT_KIND):
            continue
        yield (
            f"You named {kind} ({FAULT_KINDS[kind].description}). Which panel would show this "
            "fault, and does the panel of your report show it?",
            f"{' or '.join(panels_showing(kind))}. The panel does not show the fault. The flight "
            f"has {flight_text}.",
        )
    for fault in truth.mistakes:
        description = FAULT_KINDS[fault.kind].description
        if fault.kind not in named_kinds:
            yield (
                f"Your flight also has this fault: {description}. Show it in your report, and "
                "state its size and time.",
                f"{describe_right_answer(fault)}.",
            )
            continue
        blind_panels = [panel for panel in PANELS if panel not in panels_showing(fault.kind)]
        yield (
            f"You named the fault {fault.kind} ({description}). Show it in a panel of your report. "
            "Which other panel cannot show this fault, and why?",
            f"{describe_right_answer(fault)}. Panels that cannot show the fault, for example: "
            f"{' or '.join(blind_panels[:2])}.",
        )
    letters = dict(enumerate(form.choices))
    questions = [(*each, letters.get(index)) for index, each in enumerate(truth.choices)]
    for choice, right_letter, letter in sorted(questions, key=lambda each: each[1] == each[2]):
        answer_text = choice.answer_text(letter) if letter else "none"
        yield (
            f"{choice.question}: your answer is: {answer_text}. Explain it with the figure.",
            f"Right: {choice.answer_text(right_letter)}.",
        )
