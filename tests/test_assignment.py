"""Assignments: one flight per student, the class list, and the answer key."""

import hashlib
import json
import os
import re
import secrets
import stat
from collections import Counter

import numpy as np
import pytest
from cli_tools import run_checked
from comparisons import compare
from detector_rates import rates

import px4fuse
from px4fuse.classroom.assignment import assignment
from px4fuse.classroom.assignment.assignment import (
    answer_key_path,
    simulate_assigned_flight,
    write_assignment,
)
from px4fuse.classroom.assignment.key import AnswerKey, format_answer_key, read_answer_key
from px4fuse.classroom.assignment.random_assignment import (
    ASSIGNABLE_FAULTS,
    DIFFICULT_FAULTS_PROBABILITY,
    EASIEST_DIFFICULTY,
    HARDEST_DIFFICULTY,
    LOOP_FLIGHT_PROBABILITY,
    MAX_FAULT_DIFFICULTY,
    PROBABILITY_BY_FAULT_COUNT,
    assign_random_flight,
    derive_hmac_key,
)
from px4fuse.classroom.assignment.roster import Person
from px4fuse.diagnose import diagnose_comparison
from px4fuse.errors import OutputError, SettingsError
from px4fuse.findings import find_loop_findings
from px4fuse.loop.analysis import analyse
from px4fuse.loop.tracks import LoopSource, trajectory_of
from px4fuse.readers import ulog_topics
from px4fuse.results.answer_form import Answers, read_answers
from px4fuse.simulation.faults import parse_faults

SECRET = b"a secret for tests"
# Flight of student s1 with SECRET: seed, noise and heading, and the faults
PINNED = ((60177528313411211811171476757776911151, 0.109, -14.4), ("clock-jump=53ms", "ekf2-off"))
CLASS = tuple(Person(f"s{n:02d}", f"Name {n}") for n in range(3))
# Finding that reports each fault
FINDINGS = {
    "clock-offset": "source_time_offset", "clock-jump": "source_timestamps_are_arrival_times",
    "yaw": "source_frame_misaligned", "nlos": "source_outliers", "dropout": "source_gap",
    "imu-rate": "imu_rate_too_low", "ekf2-noise": "ekf2_overconfident",
    "ekf2-gate": "ekf2_rejects_positions", "ekf2-delay": "ekf2_ev_delay_wrong",
    "ekf2-off": "ekf2_not_fusing", "open-end": "false_loop_closure",
}  # fmt: skip
CHOICE = {choice.name: choice for choice in ASSIGNABLE_FAULTS}


def choices_of(drawn):
    return [CHOICE[typed.partition("=")[0]] for typed in drawn.mistake_options]


@pytest.fixture(autouse=True, scope="module")
def cached_flights():
    """Simulate each flight once, except in the test of equal bytes."""
    made = {}

    def from_memory(*given):
        if repr(given) not in made:
            made[repr(given)] = simulate_assigned_flight(*given)
        return made[repr(given)]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(assignment, "simulate_assigned_flight", from_memory)
        yield


def files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# ------------------------------------------------------------------ drawing


class TestDraw:
    def test_simulated_assignment_of_same_student_is_reproducible(self):
        given = SECRET, CLASS[0], "aisle", 2, True
        assert simulate_assigned_flight(*given) == assignment.simulate_assigned_flight(*given)
        # the id as another platform may spell it
        assert assign_random_flight(SECRET, "S1 ", "aisle") == assign_random_flight(
            SECRET, "s1", "aisle"
        )

    def test_flight_drawn_from_fixed_seed_has_reference_parameters(self):
        drawn = assign_random_flight(SECRET, "s1", "aisle", 2)
        scenario = drawn.scenario
        # a loop contains no ground truth, which would show the landing
        assert scenario.truth
        assert not assign_random_flight(SECRET, "s1", "loop").scenario.truth
        assert not assign_random_flight(
            SECRET, "s1", "aisle", with_ground_truth=False
        ).scenario.truth
        assert (scenario.seed, scenario.sigma_uwb_m, scenario.heading_deg) == PINNED[0]
        assert drawn.mistake_options == PINNED[1]
        loops = [
            n
            for n in range(12)
            if assign_random_flight(SECRET, f"s{n}", "mixed").scenario.kind == "loop"
        ]
        assert loops == [1, 5, 9, 11]

    @pytest.mark.parametrize("kind", ["aisle", "loop", "mixed"])
    def test_simulated_assignments_of_two_students_differ(self, kind):
        drawn = [assign_random_flight(SECRET, f"s{n}", kind).scenario for n in range(200)]
        drawn += [
            assign_random_flight(b"another secret", f"s{n}", kind).scenario for n in range(200)
        ]
        assert len({one.seed for one in drawn}) == 400
        assert len({(one.sigma_a_m_s2, one.heading_deg, one.speed_m_s) for one in drawn}) > 390

    @pytest.mark.parametrize("kind", ["aisle", "loop"])
    def test_simulated_assignments_contain_configured_fault_count(self, kind):
        flights = [assign_random_flight(SECRET, f"s{n}", kind) for n in range(1000)]
        for count, share in enumerate(PROBABILITY_BY_FAULT_COUNT[kind]):
            found = sum(len(one.mistake_options) == count for one in flights) / 1000
            assert found == pytest.approx(share, abs=0.05)
        names = {choice.name for one in flights for choice in choices_of(one)}
        assert names == {choice.name for choice in ASSIGNABLE_FAULTS if choice.flight_kind == kind}

    def test_mixed_assignments_have_requested_fraction_of_loops(self):
        mixed = [assign_random_flight(SECRET, f"s{n}", "mixed") for n in range(1000)]
        kinds = Counter(one.scenario.kind for one in mixed)
        assert kinds["loop"] / 1000 == pytest.approx(LOOP_FLIGHT_PROBABILITY, abs=0.05)
        assert all(
            one == assign_random_flight(SECRET, f"s{n}", one.scenario.kind)
            for n, one in enumerate(mixed)
        )

    def test_two_faults_of_assignment_flight_are_both_detectable(self):
        signs = Counter()
        for n in range(300):
            drawn = assign_random_flight(SECRET, f"s{n}", "aisle", 2)
            first, second = choices_of(drawn)
            assert first.is_detectable_with(second)
            assert second.is_detectable_with(first)
            parse_faults(drawn.mistake_options)
            ratios = [EASIEST_DIFFICULTY]
            for choice, text in zip(choices_of(drawn), drawn.mistake_options, strict=True):
                if not choice.detection_limit:
                    assert text == choice.name
                    continue
                size = float(re.search(r"=([-+]?[\d.]+)", text)[1])
                signs[choice.name, size > 0] += 1
                ratio = choice.detection_limit / abs(size)
                ratios.append(1.0 / ratio if choice.is_smaller_size_easier_to_detect else ratio)
                if choice.latest_start_s:
                    at = float(text.rpartition(",")[2].removesuffix("s"))
                    assert choice.earliest_start_s <= at <= choice.latest_start_s
            assert drawn.difficulty == pytest.approx(max(ratios), abs=0.011)
            assert EASIEST_DIFFICULTY <= drawn.difficulty <= MAX_FAULT_DIFFICULTY
        both = {
            choice.name
            for choice in ASSIGNABLE_FAULTS
            if choice.flight_kind == "aisle" and choice.has_either_sign
        }
        assert {name for name, positive in signs if not positive} == both

    def test_smallest_assigned_fault_is_found_in_95_percent_of_logs(self):
        """From the limit on, 95 % of the flights of tests/studies/rates.csv have the finding."""
        table = rates()
        table = table[~table.condition.str.contains("outdoor")]
        for choice in (choice for choice in ASSIGNABLE_FAULTS):
            plain = re.compile(rf"--mistake {choice.name}(=([\d.]+)\D*)?$")
            rows = table[(table.finding == FINDINGS[choice.name]) & (table.flights >= 10)]
            matches = ((plain.search(row.condition), row) for row in rows.itertuples())
            sizes = {float(match[2] or 0.0): row for match, row in matches if match}
            found = {size: row for size, row in sizes.items() if row.rate >= 0.95}
            if not choice.detection_limit:
                assert list(found) == [0.0]
                continue
            assert choice.detection_limit == (
                max if choice.is_smaller_size_easier_to_detect else min
            )(found)
            assert found[choice.detection_limit].flights >= 20
            # each larger size is found, too
            larger = [
                s
                for s in sizes
                if (s < choice.detection_limit) == choice.is_smaller_size_easier_to_detect
            ]
            assert set(larger) <= {choice.detection_limit, *found}

    def test_assignment_difficulties_cover_range_from_easy_to_hard(self):
        each = [assign_random_flight(SECRET, f"s{n}", "loop", 1).difficulty for n in range(500)]
        counts, _ = np.histogram(each, bins=4, range=(EASIEST_DIFFICULTY, HARDEST_DIFFICULTY))
        assert counts.min() > 65
        undetectable_count = sum(one > HARDEST_DIFFICULTY for one in each)
        assert undetectable_count / len(each) == pytest.approx(
            DIFFICULT_FAULTS_PROBABILITY, abs=0.06
        )

    def test_assignment_flight_seeds_have_128_bits(self):
        seeds = [assign_random_flight(SECRET, f"s{n}", "aisle").scenario.seed for n in range(50)]
        assert max(seeds).bit_length() == 128


@pytest.mark.parametrize(
    ("kind", "number", "count"), [("aisle", 0, 2), ("aisle", 2, 2), ("aisle", 2, 1), ("loop", 1, 1)]
)
def test_each_fault_in_assignment_log_is_detected_by_analysis(
    tmp_path, monkeypatch, kind, number, count
):
    log, answer = assignment.simulate_assigned_flight(SECRET, CLASS[number], kind, count, True)
    path = tmp_path / answer.file
    path.write_bytes(log)
    monkeypatch.setattr(ulog_topics, "ULOG_ASSIGNMENT_KEY", "no such key")
    flight = px4fuse.read_log(path)
    assert flight.log.sha256 == answer.sha256
    if kind == "loop":
        found = find_loop_findings(analyse(LoopSource(trajectory_of(flight, "vio"), flight)))
    else:
        found = diagnose_comparison(compare(flight, axes=("north", "east"))).findings
    drawn = assign_random_flight(SECRET, CLASS[number].student_id, kind, count)
    wanted = {FINDINGS[choice.name] for choice in choices_of(drawn)}
    assert len(wanted) == count
    assert wanted <= {finding.id for finding in found}


# ------------------------------------------------------------------ files


class TestAssign:
    """All tests use flights with two faults, which are simulated once."""

    @pytest.fixture(autouse=True)
    def fixed_secret(self, monkeypatch):
        made_up = iter([SECRET.decode()])
        monkeypatch.setattr(secrets, "token_urlsafe", lambda _: next(made_up))

    def test_assign_flights_writes_logs_answer_forms_and_answer_key(self, tmp_path):
        folder, key_file = tmp_path / "a" / "flights", tmp_path / "key.json"
        made, written = write_assignment(CLASS, folder, key_file, SECRET, "aisle", 2)
        key = read_answer_key(key_file)
        assert (key, written) == (made, 3)
        assert not key.secret
        assert SECRET.decode() not in key_file.read_text(encoding="utf-8")
        logs = files(folder)
        assert set(logs) == {
            f"s0{n}.{end}" for n in range(3) for end in ("ulg", "answers.toml", "png")
        }
        for answer in key.answers:
            assert hashlib.sha256(logs[answer.file]).hexdigest() == answer.sha256
            assert len(answer.mistakes) == 2
            assert answer.true_values["sigma_z_m"] == answer.scenario["sigma_uwb_m"]
        assert len(set(logs.values())) == 9
        form = read_answers(folder / "s00.answers.toml")
        assert form == Answers(log_sha256=key.answers[0].sha256, quantities=(None,) * 3)
        assert len(key.answers[0].form.mistakes) == 2
        if os.name == "posix":
            assert stat.S_IMODE(key_file.stat().st_mode) == 0o600

    def test_assign_flights_second_run_adds_only_new_students(self, tmp_path):
        folder, key_file = tmp_path / "flights", tmp_path / "key.json"
        assert write_assignment(CLASS[:2], folder, key_file, None, "aisle", 2)[0].secret
        before = files(folder) | {"key": key_file.read_bytes()}
        assert write_assignment(CLASS[:2], folder, key_file, None, "aisle", 2)[1] == 0
        assert files(folder) | {"key": key_file.read_bytes()} == before
        key, written = write_assignment(CLASS, folder, key_file, None, "aisle", 2)
        assert written == 1
        assert files(folder).items() >= {k: v for k, v in before.items() if k != "key"}.items()
        # the generated secret can be given later
        write_assignment(CLASS, folder, key_file, derive_hmac_key(key.secret), "aisle", 2)
        assert read_answer_key(key_file).secret == key.secret

    def test_assign_flights_does_not_overwrite_other_files(self, tmp_path):
        folder, key_file = tmp_path / "flights", tmp_path / "key.json"
        write_assignment(CLASS[:2], folder, key_file, SECRET, "aisle", 2)
        before = files(folder) | {"key": key_file.read_bytes()}
        for students, secret in ((CLASS, b"another secret"), (CLASS[2:], SECRET)):
            with pytest.raises(OutputError, match="was not overwritten"):
                write_assignment(students, folder, key_file, secret, "aisle", 2)
        with pytest.raises(OutputError, match="other flights"):
            write_assignment(CLASS[:2], tmp_path / "new", key_file, b"another secret", "aisle", 2)
        assert not (tmp_path / "new").exists()
        key_file.write_text("{}", encoding="utf-8")
        with pytest.raises(SettingsError, match="not an answer key"):
            write_assignment(CLASS[:2], folder, key_file, SECRET, "aisle", 2)
        assert files(folder) == {k: v for k, v in before.items() if k != "key"}

    def test_assign_flights_rerun_after_interrupt_completes_files(self, tmp_path, monkeypatch):
        folder, key_file = tmp_path / "flights", tmp_path / "key.json"
        flown = assignment.simulate_assigned_flight

        def stop_at_last(*given):
            if given[1] == CLASS[-1]:
                raise KeyboardInterrupt
            return flown(*given)

        monkeypatch.setattr(assignment, "simulate_assigned_flight", stop_at_last)
        with pytest.raises(KeyboardInterrupt):
            write_assignment(CLASS, folder, key_file, None, "aisle", 2)
        monkeypatch.undo()
        assert len(read_answer_key(key_file).answers) == 2
        assert write_assignment(CLASS, folder, key_file, None, "aisle", 2) == (
            read_answer_key(key_file),
            1,
        )

    def test_assignment_can_be_repeated_if_answer_key_is_missing(self, tmp_path):
        folder, key_file = tmp_path / "flights", tmp_path / "key.json"
        key_file.mkdir()
        with pytest.raises(SettingsError):
            write_assignment(CLASS[:1], folder, key_file, SECRET, "aisle", 2)
        blocked = tmp_path / "file"
        blocked.write_bytes(b"")
        kept = tmp_path / "k.json"
        for where, key, secret in (
            (folder, blocked / "key.json", SECRET),
            (blocked, kept, None),
        ):
            with pytest.raises(OutputError, match="cannot be written"):
                write_assignment(CLASS[:1], where, key, secret, "aisle", 2)
        assert not any(path.is_file() for path in folder.rglob("*"))
        assert stat.S_IMODE(kept.stat().st_mode) == 0o600 or os.name == "nt"
        assert write_assignment(CLASS[:1], folder, kept, None, "aisle", 2) == (
            read_answer_key(kept),
            1,
        )

    def test_answer_key_path_inside_students_folder_is_rejected(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        flights = tmp_path / "flights"
        assert answer_key_path(flights, None) == tmp_path / "flights_answers.json"
        flights.mkdir()
        monkeypatch.chdir(flights)
        for here in (".", "../flights", "../flights/."):
            path = answer_key_path(type(flights)(here), None)
            assert path.resolve() == tmp_path / "flights_answers.json"
        for inside in (flights / "key.json", flights / "a" / "key.json", flights):
            with pytest.raises(OutputError, match="students' folder"):
                answer_key_path(flights, inside)


class TestKey:
    def key(self):
        answers = (
            assignment.simulate_assigned_flight(SECRET, one, "aisle", 2, True)[1]
            for one in CLASS[:2]
        )
        return AnswerKey("aisle", tuple(answers), "s")

    def test_answer_key_written_to_file_is_read_back_equal(self, tmp_path):
        path = tmp_path / "key.json"
        path.write_text(format_answer_key(self.key()), encoding="utf-8")
        assert read_answer_key(path) == self.key()
        assert "Do not hand it out" in path.read_text(encoding="utf-8")

    def test_read_invalid_answer_key_raises_one_line_error(self, tmp_path):
        good = json.loads(format_answer_key(self.key()))

        def with_values(**values):
            return json.dumps({**good, **values})

        def with_student(**values):
            return with_values(students=[{**good["students"][0], **values}])

        texts = [
            "", "[" * 1_000_000, "9" * 10_000,
            with_values(schema={**good["schema"], "version": 99}),
            with_values(students=[]), with_values(students=[good["students"][0]] * 2),
            with_values(students=good["students"] * 600), with_student(id=" "),
            with_student(sha256="x" * 64), with_student(name="x" * 2000),
            with_student(mistakes=["x"] * 100), with_student(truth={"sigma_z_m": True}),
        ]  # fmt: skip
        path = tmp_path / "key.json"
        for text in texts:
            path.write_text(text, encoding="utf-8")
            with pytest.raises(SettingsError) as error:
                read_answer_key(path)
            assert "\n" not in str(error.value)
        for content in (b"\xff\xff", b" " * 20_000_001):
            path.write_bytes(content)
            with pytest.raises(SettingsError):
                read_answer_key(path)


# ------------------------------------------------------------------ command


class TestCommand:
    @pytest.fixture
    def at(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "roster.csv").write_text("id,name\ns01,=cmd|x\ns02,<b>\n")
        (tmp_path / "secret.txt").write_text("\ufeffour secret of 2026\r\n", encoding="utf-8")
        return tmp_path

    def test_simulate_same_assignment_again_writes_no_files(self, at):
        given = ("--assignment", "roster.csv", "-o", "f", "--kind", "mixed", "--mistakes", "1",
                 "--secret-file", "secret.txt")  # fmt: skip
        run_checked("simulate", *given)
        assert "0 logs written, 2 existed already" in run_checked("simulate", *given).output
        assert "our secret" not in (at / "f_answers.json").read_text(encoding="utf-8")

    def test_answer_key_of_assignment_contains_new_secret_seed(self, at):
        given = "--assignment", "roster.csv", "-o", "g", "--kind", "loop"
        kept = run_checked("simulate", *given).output
        assert "answer key contains a new secret" in kept
        assert read_answer_key(at / "g_answers.json").secret not in kept
