"""Points, comments, feedback and flags of the example report with changed results."""

import copy
import json
import random
import re
from pathlib import Path

import pytest
from exchange import replace
from results_tools import (
    EXAMPLE,
    LOOP,
    SHA256,
    changed_results,
    decode_results,
    finding,
)

from px4fuse.classroom.assignment.key import (
    AnswerKey,
    CorrectAnswers,
    CorrectFormAnswers,
    CorrectVerdict,
    InjectedFault,
)
from px4fuse.classroom.grading.model import Grade, GradedReport
from px4fuse.classroom.grading.outputs import feedback_text
from px4fuse.classroom.grading.rubric import (
    flag_equal_contents,
    flag_settings,
    parse_rubric,
    read_rubric,
    score_report,
)
from px4fuse.errors import ResultsError
from px4fuse.findings.model import FINDING_TITLES
from px4fuse.results.answer_form import Answers, NamedFault
from px4fuse.verification.model import Verification
from px4fuse.verification.pdf_input import read_report
from px4fuse.verification.verification import verify

ROOT = Path(__file__).parent.parent
VERIFIED = Verification("verified", ("all 900 numbers agree",), with_log=True)
SHA = SHA256
NONE = {"what": "it", "reason": "too few of them", "remedy": ""}


def assess_results(results=EXAMPLE, verdict=VERIFIED, key=None, rubric=None, submitter_id=""):
    return score_report(
        decode_results(results), verdict, rubric or read_rubric(None), key, submitter_id
    )


def check_points(check, results=EXAMPLE, /, verdict=VERIFIED, key=None, **parameters):
    """Return points (of 1) and comment of one check."""
    given = "\n".join(f"{name} = {json.dumps(value)}" for name, value in parameters.items())
    rubric = parse_rubric(f'[[item]]\ntitle = "T"\npoints = 1\ncheck = "{check}"\n{given}', "x")
    (item,) = assess_results(results, verdict, key, rubric).items
    assert item.comment.endswith(".")
    assert "\n" not in item.comment
    return item.points, item.comment


def with_notes(text, results=EXAMPLE, **values):
    return changed_results(results, student__notes=text, **values)


def with_form(kinds, results=EXAMPLE, **values):
    """Return results with an answer form that contains these mistakes."""
    sha256 = (results.get("log") or results["track"])["sha256"]
    form = {"log_sha256": sha256, "mistakes": [{"kind": kind} for kind in kinds]}
    return changed_results(results, student__answers=form, **values)


# ------------------------------------------------------------------ checks


def test_report_without_log_earns_no_points_for_verification():
    pdf = (ROOT / "reports" / "example" / "aisle_uwb.pdf").read_bytes()
    verdict = verify(read_report(pdf, "a.pdf"), pdf, {})
    assert check_points("verified", verdict=verdict)[0] == 0.0
    assert "Hand in aisle_uwb.ulg" in feedback_words(graded(verification=verdict))
    other = replace(verdict, reasons=("made with another version",), missing="")
    points, comment = check_points("verified", verdict=other)
    assert (points, comment[-28:]) == (0.0, "(made with another version).")


GAIN = "log_likelihood_gain_per_measurement"
RMSE = "axes.north.filters.kf.truth.position_rmse_m"
BLIND = changed_results(axes__north__filters__kf__truth=NONE)
NORTH = changed_results(axes={"north": EXAMPLE["axes"]["north"]}, tuning={}, horizontal={})
SIGMA_Z = "tuning__horizontal__sigma_z_m"
UNCLEAR = changed_results(clock__is_determinable=False, clock__reason="no acceleration.")
JUMPS = {"clock__applied_s": 0.25, "findings": [finding("source_time_offset_changes")]}
OVERSTATED = changed_results(horizontal__kf__verdict="underconfident", horizontal__kf__nis_mean=0.5)
UNDERSTATED = {"horizontal__kf__verdict": "overconfident", "horizontal__kf__nis_mean": 4.4}
AFTER = "loop__corrections__by_distance"
REJECTED = changed_results(
    LOOP, loop__closures=[{**LOOP["loop"]["closures"][0], "accepted": False}]
)
# Check, results, parameters, points of 1, part of the comment
CHECKED = [
    ("verified", EXAMPLE, {}, 1.0, "verified (all 900"),
    ("tuning", EXAMPLE, {"setting": "sigma_z_m"}, 1.0, "within"),
    ("tuning", EXAMPLE, {"setting": "sigma_a_m_s2"}, 0.72, "SIGMA_A"),
    ("tuning", changed_results(settings__sigma_a_m_s2=0.1), {"setting": "sigma_a_m_s2"}, 0.0,
     "below"),
    ("tuning", changed_results(**{SIGMA_Z: ..., f"{SIGMA_Z}_interval": [0.0, 0.2]}),
     {"setting": "sigma_z_m"}, 1.0, "within"),
    ("tuning", changed_results(tuning__horizontal=NONE), {"setting": "sigma_z_m"}, 0.0,
     "too few of them"),
    ("tuning", NORTH, {"setting": "sigma_z_m"}, 0.0, "without --axis"),
    ("number", EXAMPLE, {"path": RMSE, "at_most": 0.05, "name": "the error"}, 0.0,
     "The error is 0.06499; required: at most 0.05."),
    ("number", EXAMPLE, {"path": RMSE, "at_most": 0.06, "zero_at": 0.07}, 0.5, ""),
    ("number", EXAMPLE, {"path": RMSE, "at_least": 0.07, "zero_at": 0.06}, 0.5, ""),
    ("number", EXAMPLE, {"path": "axes.*.filters.kf.nis_mean", "at_least": 0.82}, 0.0,
     "axes.north"),  # worst of several values
    ("number", LOOP, {"path": 'loop.corrections.by_distance.scores."slam.tum".ate.translation_m.'
                              "rmse", "at_most": 0.3}, 1.0, ""),
    ("number", EXAMPLE, {"path": "clock.interval_s.1", "at_most": 0.1}, 1.0, ""),
    ("number", BLIND, {"path": "log.name", "at_most": 1.0}, 0.0, "does not contain"),
    ("number", NORTH, {"path": f"tuning.horizontal.held_out.{GAIN}", "at_most": 1.0}, 0.0,
     "without --axis"),
    ("consistent", changed_results(horizontal__kf__verdict="consistent"), {}, 1.0, "is consistent"),
    ("consistent", EXAMPLE, {}, 1.0, "KF is consistent."),
    ("consistent", OVERSTATED, {}, 0.5, "σ of KF is 1.41 times too large"),
    ("consistent", OVERSTATED, {"factor": 1.25}, 0.0, "σ of KF is 1.41 times too large"),
    ("consistent", changed_results(horizontal__kf__verdict="overconfident",
     horizontal__kf__nis_mean=2.0), {}, 0.5, "1.41 times too small"),
    ("consistent", NORTH, {}, 0.0, "without --axis"),
    ("consistent", changed_results(**UNDERSTATED), {}, 0.0, "2.1 times too small"),
    ("consistent", changed_results(**UNDERSTATED, settings__sigma_a_m_s2=0.36), {}, 1.0,
     "makes KF consistent"),
    ("clock", EXAMPLE, {}, 1.0, "estimated time offset is -0.022 to 0.060 s"),
    ("clock", changed_results(clock__applied_s=0.25), {}, 0.0, "0.250 s"),
    ("clock", UNCLEAR, {}, 0.5, "no acceleration)."),
    ("clock", changed_results(clock=NONE), {}, 0.0, "too few of them"),
    ("clock", changed_results(**JUMPS), {}, 0.5, "State the time of the change"),
    ("clock", with_form(["clock-jump"], **JUMPS), {}, 1.0, "as your form states"),
    ("clock", with_form(["dropout"], **JUMPS), {}, 0.5, "State the time of the change"),
    ("loop", LOOP, {}, 1.0, "drift of the path was corrected"),
    ("loop", changed_results(LOOP, **{AFTER: NONE}), {}, 0.5, "not corrected"),
    ("loop", EXAMPLE, {}, 0.0, "no external vision with orientation"),
    ("loop", changed_results(LOOP, loop__is_absolute_track=True), {}, 0.0, "does not drift"),
    ("loop", REJECTED, {}, 0.25, "No loop closure was accepted"),
    ("loop", changed_results(LOOP, loop__closure_error_m=..., loop__true_end=NONE), {}, 0.0,
     "too few of them"),
    ("number", changed_results(axes__north__updates__count=50), {"path": "axes.*.updates.count",
     "at_least": 100, "zero_at": 0}, 0.5, "axes.north"),
]  # fmt: skip


@pytest.mark.parametrize(("check", "results", "given", "points", "said"), CHECKED)
def test_each_rubric_check_gives_expected_points_and_comment(check, results, given, points, said):
    found, comment = check_points(check, results, **given)
    assert found == pytest.approx(points, abs=0.01), comment
    assert said in comment


def test_report_with_undeterminable_time_offset_earns_points():
    assert check_points("clock", UNCLEAR, key=key())[0] == 1.0


# ------------------------------------------------------------------ faults


TRUTH = CorrectFormAnswers(
    (InjectedFault("dropout", 3.0, 2.55, 3.45, 50.0, 53.0),), 0.1, CorrectVerdict("consistent"),
    CorrectVerdict("consistent"), ("dead-reckoned, then reset",), (), (0.5, 0.1, 0.2),
)  # fmt: skip


def key(*mistakes, sha256=SHA, **values):
    answer = CorrectAnswers("s01", "Ann", "s01.ulg", sha256, {}, mistakes, form=TRUTH, **values)
    other = CorrectAnswers("s02", "Bob", "s02.ulg", "b" * 64)
    return AnswerKey("aisle", (answer, other))


class TestForm:
    def test_answer_form_earns_points_only_for_injected_faults(self):
        found = with_form(["dropout"], student__id="S01 ")
        points, comment = check_points("answers", found, key=key())
        assert points == 0.3
        assert "mistakes 30 of 30, sizes 0 of 15" in comment
        assert "you named dropout, which is right (" in comment.lower()
        points, comment = check_points("answers", with_form(["yaw"], student__id="s01"), key=key())
        assert points == 0.0
        assert (
            "you did not name dropout (duration of a gap in the position source)" in comment.lower()
        )
        assert "flight does not have: yaw" in comment

    @pytest.mark.parametrize(
        ("form", "said"),
        [
            ({}, "report contains no answer form"),
            ({"log_sha256": "c" * 64}, "are about different logs"),
            ({"log_sha256": SHA, "mistakes": [{"kind": "gremlins"}]}, "cannot be read (kind"),
            ({"log_sha256": SHA, "mistakes": [{"kind": "yaw", "size": 900.0}]}, "cannot be read"),
        ],
    )
    def test_missing_or_invalid_answer_form_earns_zero_points(self, form, said):
        more = {"student__answers": form} if form else {}
        points, comment = check_points(
            "answers", changed_results(student__id="s01", **more), key=key()
        )
        assert (points, said in comment) == (0.0, True)

    def test_answer_form_about_other_log_earns_zero_points(self):
        for student_id in ("s01", "zz"):
            results = with_form(["dropout"], student__id=student_id)
            points, comment = check_points("answers", results, key=key(sha256="c" * 64))
            assert (points, "not about the log that you were given" in comment) == (0.0, True)

    @pytest.mark.parametrize(("submitter_id", "points"), [("", 0.0), ("s01", 30.0), ("zz", 0.0)])
    def test_id_of_learning_platform_replaces_mistyped_report_id(self, submitter_id, points):
        mistyped = with_form(["dropout"], student__id="s02")
        items = assess_results(mistyped, key=key(), submitter_id=submitter_id).items
        assert [item.points for item in items if "faults" in item.title] == [points]

    def test_points_for_student_notes_are_pending_until_graded(self):
        for notes, is_awaiting_points in (("", False), ("I saw a gap.", True)):
            made = assess_results(with_notes(notes, student__id="s01"), key=key())
            assert (
                made.is_awaiting_points,
                made.counted_points is None,
                made.items[-1].points,
            ) == (
                is_awaiting_points,
                is_awaiting_points,
                0.0,
            )


# ------------------------------------------------------------------ whole reports


class TestScore:
    def test_report_that_differs_from_recomputed_one_earns_nothing(self):
        verdict = Verification("numbers differ", ("SIGMA_A is 0.5",), with_log=True)
        made = assess_results(verdict=verdict)
        assert {item.points for item in made.items} == {0.0}
        assert all("SIGMA_A is 0.5" in item.comment for item in made.items)
        assert made.instructor_action == ""

    def test_rubric_decides_points_of_unverified_report(self):
        verdict = Verification("other log", ("no log",), False, remedy="Look.")
        made = assess_results(verdict=verdict)
        assert made.items[0].points == 0.0
        assert sum(item.points for item in made.items) > 30
        assert made.instructor_action == "Look."
        zero = assess_results(verdict=verdict, rubric=replace(read_rubric(None), unverified="zero"))
        assert {item.points for item in zero.items} == {0.0}
        assert zero.instructor_action == ""

    @pytest.mark.parametrize("student_id", ["s02", "S02", "ѕ02", "s77", "", " "])
    def test_log_of_other_student_counts_only_if_rubric_allows(self, student_id):
        given = changed_results(student__id=student_id)
        said = f"the student id {student_id}" if student_id.strip() else "no student id"
        assert (
            f"assigned to student s01, but the report contains {said}"
            in assess_results(given, key=key()).instructor_action
        )
        for rule, earns in (("zero", False), ("count", True)):
            rubric = replace(read_rubric(None), others_log=rule)
            made = assess_results(given, key=key(), rubric=rubric)
            assert (made.instructor_action, any(item.points for item in made.items)) == ("", earns)
        # with the owner from the platform
        assert assess_results(given, key=key(), submitter_id="s01").instructor_action == ""

    def test_report_on_log_missing_in_answer_key_is_pending_review(self):
        made = assess_results(with_notes("", student__id="s01"), key=key(sha256="c" * 64))
        assert "log of the report is not in the answer key" in made.instructor_action

    @pytest.mark.slow
    @pytest.mark.parametrize("results", [EXAMPLE, LOOP], ids=["compare", "loop"])
    def test_any_results_that_follow_the_schema_can_be_scored(self, results):
        """Extreme values and missing parts, as far as the schema allows."""
        rng = random.Random(0)
        numbers, others = [1e308, -1e308, 5e-324, 0.0, -1, 10**19], [NONE, ..., "x" * 2000, "\0"]
        rubric, read = read_rubric(None), 0
        for _ in range(800):
            spoilt = copy.deepcopy(results)
            for _ in range(rng.randint(1, 3)):
                place = spoilt
                while isinstance(place, dict) and place:
                    name = rng.choice(list(place))
                    if rng.random() < 0.1 or not isinstance(place[name], dict):
                        strange = numbers if isinstance(place[name], float) else others
                        value = copy.deepcopy(rng.choice(strange))
                        place[name] = value
                        if value is ...:
                            del place[name]
                        break
                    place = place[name]
            try:
                found = decode_results(spoilt)
            except ResultsError:
                continue
            read += 1
            for item in score_report(found, VERIFIED, rubric, key()).items:
                assert 0.0 <= item.points <= item.max_points
                assert len(item.comment) < 1500
                assert item.comment.isprintable()
            list(flag_settings(found))
        assert read > 40


def feedback_words(one, title=""):
    """Return the feedback text without line ends."""
    text = feedback_text(Grade(one.student, one.student_id, one), title)
    assert all(len(line) <= 100 for line in text.splitlines())
    return " ".join(text.split())


def graded(items=(), **values):
    given = {"submission": "a.pdf", "student": "Ann Lee", "student_id": "1001"}
    return GradedReport(**{**given, "verification": VERIFIED, "items": tuple(items), **values})


class TestFeedback:
    @pytest.mark.parametrize(
        ("values", "there", "absent"),
        [
            ({"items": assess_results().items, "flags": ("copied",)},
             ("Lab 2 Report a.pdf Student Ann Lee, 1001",), "copied"),
            ({"verification": Verification("cannot verify", ("one", "page 3: two"), False)},
             ("could not be verified: one; page 3: two. Make a new report",), "Points"),
            ({"student": "=cmd|' /C calc'!A0\n<script>", "student_id": "\x1b[31m"},
             ("=cmd|' /C calc'!A0 <script>",), "\x1b"),
            ({"items": assess_results().items, "instructor_action": "Add uwb.csv to the --logs"},
             ("pending, not counted yet",), "--logs"),
        ],
    )  # fmt: skip
    def test_student_feedback_omits_warnings_for_the_instructor(self, values, there, absent):
        text = feedback_words(graded(**values), "Lab 2")
        assert all(said in text for said in there), text
        assert absent not in text

    def test_grading_comments_contain_no_internal_names(self):
        """Ids of findings and paths in results are internal names."""
        wrong = [finding(name, "error") for name in FINDING_TITLES]
        spoilt = [
            changed_results(findings=wrong, student__notes="It is a flight of 5 s.", tuning={},
                            clock=NONE),
            changed_results(LOOP, findings=wrong, loop__closure_error_m=..., loop__true_end=NONE,
                    loop__closures=[]),
            with_form(["nlos", "dropout"], student__id="s01", findings=wrong),
        ]  # fmt: skip
        for results in spoilt:
            for answers in (None, key()):
                for item in assess_results(results, key=answers).items:
                    left = item.comment.replace("answers.toml", "")
                    assert not re.search(r"[a-z]+_[a-z]+|\w\.\*|\w\.[a-z]", left), item.comment


# ------------------------------------------------------------------ flags


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({}, ()),
        ({"request__end_s": 50.0, "settings__end_s": 50.0}, ("37%",)),
        ({"request__start_s": 1.0}, ()),
        ({"settings__end_s": 50.0}, ()),
        ({"settings__input": "zero"}, ("IMU",)),
        ({"source__path": "kept by EKF2"}, ("kept by EKF2",)),
    ],
)
def test_report_with_suspicious_settings_is_flagged(values, said):
    found = list(flag_settings(decode_results(changed_results(**values))))
    assert len(found) == len(said)
    assert all(word in flag for word, flag in zip(said, found, strict=True))
    assert list(flag_settings(decode_results(LOOP))) == []


@pytest.mark.parametrize(
    ("option", "stated", "said"),
    [
        ("position_drift_m", 3.9, ""),
        ("position_drift_m", 50.0, "--drift is 50 m per 100 m (default 1 m)."),
        ("position_drift_m", 0.2, "--drift is 0.2 m per 100 m"),
        ("heading_drift_deg", 90.0, "--heading-drift is 90 ° per 100 m (default 3 °)."),
    ],
)
def test_report_with_drift_option_far_from_default_is_flagged(option, stated, said):
    found = list(
        flag_settings(decode_results(changed_results(LOOP, **{f"request__{option}": stated})))
    )
    assert len(found) == bool(said)
    assert all(flag.startswith(said) for flag in found)


def report(number, **values):
    given = {
        "submission": f"{number}.pdf", "student": f"Student{number} Name{number}",
        "student_id": f"10{number:02d}", "sha256": f"{number:064d}",
        "log_sha256": f"{number + 500:064d}", "version": "0.1.0",
    }  # fmt: skip
    return graded(**{**given, **values})


class TestClassFlags:
    def test_different_reports_are_not_flagged_as_copies(self):
        assert flag_equal_contents([report(n) for n in range(12)]) == {}

    def test_reports_with_same_log_id_or_file_are_flagged_as_copies(self):
        made = flag_equal_contents(
            [report(1, student="a\n<b>", log_sha256="x"), report(2, log_sha256="x"), report(4),
             report(5),
             report(6, student_id="1005"),
             report(7, sha256="y"), report(8, sha256="y")]
        )  # fmt: skip
        assert set(made) == {f"{n}.pdf" for n in (1, 2, 5, 6, 7, 8)}
        assert "same log as the report of Student2" in made["1.pdf"][0]
        for flag in (flag for flags in made.values() for flag in flags):
            assert re.fullmatch(r"[A-Z].*\.", flag)
            assert flag.isprintable()
        assert "The student id in this report is also in the report of" in made["5.pdf"][0]
        assert "identical to the PDF of" in made["8.pdf"][0]

    def test_two_reports_with_one_student_id_are_flagged(self):
        two = [
            report(1, log_sha256="x"),
            report(1, log_sha256="x", sha256="z", submission="b.pdf"),
        ]
        assert flag_equal_contents(two) == {
            "1.pdf": [
                "The student id in this report is also in the report of "
                "Student1 Name1, 1001 (b.pdf)."
            ],
            "b.pdf": [
                "The student id in this report is also in the report of "
                "Student1 Name1, 1001 (1.pdf)."
            ],
        }

    def test_reports_with_similar_answer_forms_are_flagged(self):
        claims = NamedFault("yaw", -20.5), NamedFault("nlos", 1.23)
        mine = Answers(log_sha256=SHA, mistakes=claims, quantities=(0.123, None, 0.45))
        other = (NamedFault("nlos", 1.24), NamedFault("yaw", -20.3))
        theirs = Answers(log_sha256=SHA, mistakes=other, quantities=(0.124, 0.7, None))
        made = flag_equal_contents([report(1, form=mine), report(2, form=theirs)])
        assert set(made) == {"1.pdf", "2.pdf"}
        assert "The answer form contains the same numbers as the answer form of" in made["1.pdf"][0]
        # two equal numbers are not enough
        theirs = replace(theirs, quantities=(0.2, 0.7, 0.45))
        apart = replace(mine, quantities=(0.123, None, 0.3))
        assert flag_equal_contents([report(1, form=apart), report(2, form=theirs)]) == {}
