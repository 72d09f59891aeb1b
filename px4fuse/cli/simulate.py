"""``px4fuse simulate``: flights with known ground truth and chosen mistakes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, cast

import click

from px4fuse.cli.inputs import InputPath, TypedQuantity, options, typed_parameters
from px4fuse.cli.outputs import check_targets, progress, write_and_print
from px4fuse.errors import OutputError, SettingsError, to_one_line
from px4fuse.input_files import check_output_folder
from px4fuse.reading import read_text
from px4fuse.simulation.mistakes import MISTAKES, active_mistakes, format_mistake, parse
from px4fuse.simulation.scenario import (
    DEFAULTS_OF_KIND,
    Kind,
    Scenario,
    Yaw,
    make_scenario,
    quantities,
)

if TYPE_CHECKING:
    from px4fuse.assignment.random_assignment import Kinds
    from px4fuse.report.page import Page
    from px4fuse.simulation.flights import Simulation

_DEFAULT = Scenario()
MIXED = "mixed"
OUTDOOR: Kind = "outdoor"
SOURCES = {"aisle": "UWB", "loop": "VIO", OUTDOOR: "GNSS"}
# Options that require --assignment, and all options that are allowed with it
ASSIGNMENT_ONLY_OPTIONS = ("secret_file", "mistakes", "preview")
ASSIGNMENT_OPTIONS = (
    "output",
    "assignment",
    "kind",
    "answer",
    "no_truth",
    *ASSIGNMENT_ONLY_OPTIONS,
)
MAX_SECRET_BYTES = 10_000
Command = TypeVar("Command", bound=Callable[..., None])


def _scenario_options(command: Command) -> Command:
    """Add an option for each number of the scenario; its field has the default and the help."""
    for field, quantity in reversed(quantities(Scenario).items()):
        if not quantity.meaning:
            continue
        default, outdoors = getattr(_DEFAULT, field), DEFAULTS_OF_KIND[OUTDOOR].get(field)
        default_text = f"{default:g}" + (f"; outdoors {outdoors:g}" if outdoors else "")
        help_text = f"{quantity.meaning}  [default: {default_text}]"
        kind = TypedQuantity(quantity.unit, default)
        command = click.option(quantity.cli_name, field, type=kind, help=help_text)(command)
    return command


class WithMistakes(click.Command):
    """Command whose help ends with the table of mistakes."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Add the table of mistakes to the help."""
        with formatter.section("Mistakes [value without =VALUE]"):
            formatter.write_dl(
                [
                    (
                        f"{name}{mistake.usage}",
                        mistake.help + (f" [{mistake.default:g}]" if mistake.sizes else ""),
                    )
                    for name, mistake in MISTAKES.items()
                ]
            )


@click.command(cls=WithMistakes)
@options("simulate", assignment={"type": InputPath()}, secret_file={"type": InputPath()})
@_scenario_options
def simulate(
    output: Path,
    *,
    assignment: Path | None,
    secret_file: Path | None,
    mistakes: int | None,
    mistake: tuple[str, ...],
    answer: Path | None,
    no_truth: bool,
    no_ekf2: bool,
    preview: bool,
    kind: Literal[Kind, "mixed"] = _DEFAULT.kind,
    seed: int = _DEFAULT.seed,
    passes: int | None,
    yaw: Yaw | None,
    **chosen: Any,
) -> None:
    """Simulate a flight with known ground truth and chosen mistakes.

    Writes a PX4 ULog for exercises and exams, with ground truth unless --no-truth. The log states
    that it is simulated, but not which mistakes it contains. EKF2 in it is px4fuse's model, not
    PX4's code.

    For example, px4fuse simulate -o s07.ulg --seed 7 --mistake nlos=5% --answer s07.json

    With --assignment, writes one flight per student:
    px4fuse simulate --assignment roster.csv -o flights
    """
    _check_options(assignment)
    if assignment is not None:
        drawn_from = _read_secret(secret_file), cast("Kinds", kind), mistakes
        _write_assignment(
            assignment, output, answer, *drawn_from, truth=not no_truth, preview=preview
        )
        return
    if kind == MIXED:
        raise SettingsError(f"--kind {MIXED} requires --assignment ROSTER.csv.")
    if output.suffix.lower() != ".ulg":
        raise OutputError(f"{output}: the output is a ULog. Give a name ending in .ulg (-o).")
    check_targets([output, answer])
    parsed = parse(mistake)
    chosen |= {"seed": seed, "passes": passes, "yaw": yaw}
    scenario = make_scenario(
        cast(Kind, kind),
        truth=not no_truth,
        ekf2=not no_ekf2,
        **{name: value for name, value in chosen.items() if value is not None},
    )
    from px4fuse.results.contract import to_json
    from px4fuse.simulation import flights

    with progress() as step:
        step("simulating")
        simulation = flights.simulate(scenario, parsed)
        step("writing the log")
        contents = {output: flights.to_ulog(simulation)}
    if answer is not None:
        contents[answer] = to_json(flights.answer(simulation)).encode()
    write_and_print(contents, _page(simulation, answer))


def _check_options(assignment: Path | None) -> None:
    """Reject options that cannot be combined."""
    if assignment is not None and click.get_current_context().params["kind"] == OUTDOOR:
        raise SettingsError(
            f"--kind {OUTDOOR} is not available with --assignment.",
            f"Use --kind aisle, loop or {MIXED}.",
        )
    for parameter in typed_parameters():
        if assignment is not None and parameter.name not in ASSIGNMENT_OPTIONS:
            raise SettingsError(
                f"{parameter.opts[0]} is not available with --assignment, which draws it at random "
                "for each student",
                "Omit it.",
            )
        if assignment is None and parameter.name in ASSIGNMENT_ONLY_OPTIONS:
            raise SettingsError(f"{parameter.opts[0]} requires --assignment ROSTER.csv.")


def _read_secret(file: Path | None) -> bytes | None:
    from px4fuse.assignment.random_assignment import encode_secret

    if file is None:
        return None
    name = f"--secret-file {file}"
    text = read_text(
        file, SettingsError, MAX_SECRET_BYTES, name=name, size_remedy="Give a line of text"
    )
    return encode_secret(text, name)


def _write_assignment(
    roster: Path,
    folder: Path,
    answer_path: Path | None,
    secret: bytes | None,
    kind: Kinds,
    count: int | None,
    *,
    truth: bool,
    preview: bool,
) -> None:
    """Write one flight per student and the answer key, or only print what would be drawn."""
    from px4fuse.assignment import assignment
    from px4fuse.assignment.random_assignment import EASIEST_DIFFICULTY, HARDEST_DIFFICULTY
    from px4fuse.assignment.roster import read_roster
    from px4fuse.report.page import Page

    students, page, ends = read_roster(roster), Page(), dict[str, str]()
    key_file = assignment.key_path(folder, answer_path)
    check_targets([key_file])
    check_output_folder(folder)
    drawn_flights: list[tuple[tuple[str, ...], float | None]]
    if preview:
        previews = assignment.preview(students, key_file, secret, kind, count)
        drawn_flights = [(drawing.mistake_options, drawing.difficulty) for drawing in previews]
        rows = [
            (
                student.student_id,
                student.name,
                drawing.scenario.kind,
                " ".join(drawing.mistake_options) or "none",
                f"{drawing.difficulty:.2f}",
            )
            for student, drawing in zip(students, previews, strict=True)
        ]
        page.table(("student", "name", "flight", "mistakes", "difficulty"), rows, right=(4,))
        ends["Preview"] = (
            "nothing was written. Not for students: the table lists the mistakes of each flight."
        )
    else:
        with progress() as step:
            show_progress = partial(step, "simulating")
            key, written = assignment.assign(
                students, folder, key_file, secret, kind, count, truth, show_progress
            )
        drawn_flights = [(answer.mistakes, answer.difficulty) for answer in key.answers]
        at, key_at = (to_one_line(str(path)) for path in (folder, key_file))
        existing_count = len(drawn_flights) - written
        ends["Flights"] = f"{at} ({written} written, {existing_count} existed already)"
        ends["Answers"] = f"{key_at} (not for students: it lists the mistakes of each flight)"
        if key.secret:
            ends["Secret"] = (
                "generated, and stored in the answers. With that file the same flights can be "
                "written again, and students can be added later."
            )
    counts = Counter(
        mistake.partition("=")[0] for typed, _ in drawn_flights for mistake in typed or ("none",)
    )
    difficulties = [difficulty for _, difficulty in drawn_flights if difficulty is not None]
    page.advice(
        {
            "Class": f"{len(drawn_flights)} student{'s' * (len(drawn_flights) != 1)}, {kind}",
            "Mistakes": ", ".join(f"{name} {number}" for name, number in sorted(counts.items())),
            "Difficulty": f"{min(difficulties):.2f} to {max(difficulties):.2f}, drawn between "
            f"{EASIEST_DIFFICULTY:g} and {HARDEST_DIFFICULTY:g}: size that px4fuse detects in 19 "
            "of 20 flights, divided by the drawn size, for the most difficult mistake",
            **ends,
        }
    )
    write_and_print({}, page)


def _page(simulation: Simulation, answer: Path | None) -> Page:
    """Describe the simulated flight for the terminal."""
    from px4fuse.report.page import Page

    scenario, page = simulation.scenario, Page()
    names = active_mistakes(simulation.mistakes)
    loop, many = scenario.kind == "loop", scenario.passes > 1
    path = f"{scenario.passes} lap{'s' * many} of a square of {scenario.length_m:g} m"
    if scenario.kind == "aisle":
        path = f"{scenario.passes} pass{'es' * many} of {scenario.length_m:g} m"
    page.advice(
        {
            "Flight": f"{scenario.kind}, {path} at {scenario.speed_m_s:g} m/s, "
            f"{simulation.motion.duration_s:g} s, seed {scenario.seed}",
            "Position": f"{SOURCES[scenario.kind]}, {scenario.source_sigma_m:g} m at "
            f"{scenario.source_rate_hz:g} Hz"
            + (f", drift {scenario.vio_drift:.1%} of the path" if loop else ""),
            "IMU": f"{scenario.imu_rate_hz:g} Hz, SIGMA_A {scenario.sigma_a_m_s2:g} m/s²",
        }
    )
    mistake_texts = [
        f"{format_mistake(name, simulation.mistakes)}: {MISTAKES[name].help}" for name in names
    ]
    page.labelled("Mistakes", *(mistake_texts or ["none"]))
    page.labelled("Truth", "logged" if scenario.truth else "not logged")
    none = "not simulated and not in the log"
    page.labelled("EKF2", "px4fuse's model of EKF2" if scenario.ekf2 else none)
    if answer is not None:
        page.labelled("Answer", f"{to_one_line(str(answer))} (not for students)")
    return page
