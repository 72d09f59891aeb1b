"""Command ``px4fuse simulate``: simulates flights with ground truth and injected faults."""

from functools import partial
from pathlib import Path
from typing import Any, get_args

import click

from px4fuse.core.input_files import check_output_folder
from px4fuse.core.reading import read_text
from px4fuse.errors import OutputError, SettingsError
from px4fuse.simulation.faults import FAULT_TYPES, parse_faults
from px4fuse.simulation.scenario import (
    DEFAULTS_BY_KIND,
    Scenario,
    ScenarioKind,
    YawMode,
    collect_field_bounds,
    make_scenario,
)

from .options import (
    Choice,
    CommandFunction,
    NonEmptyPath,
    NumberWithUnit,
    flag_option,
    input_option,
    list_given_parameters,
    output_option,
)
from .outputs import check_output_paths, progress, write_and_print_results

_DEFAULT_SCENARIO = Scenario()
MIXED_KIND = "mixed"
OUTDOOR_KIND: ScenarioKind = "outdoor"
ASSIGNMENT_ONLY_OPTIONS = ("secret_file", "fault_count")
# Options that can be combined with --assignment
ASSIGNMENT_OPTIONS = (
    "output",
    "assignment",
    "kind",
    "answer_key_path",
    "no_truth",
    *ASSIGNMENT_ONLY_OPTIONS,
)
MAX_SECRET_BYTES = 10_000


def _add_scenario_options(command: CommandFunction) -> CommandFunction:
    """Add a command-line option for each numeric field of Scenario."""
    for field, quantity in reversed(collect_field_bounds(Scenario).items()):
        if not quantity.help_or_placeholder:
            continue
        default = getattr(_DEFAULT_SCENARIO, field)
        outdoor_default = DEFAULTS_BY_KIND[OUTDOOR_KIND].get(field)
        default_text = f"{default:g}" + (
            f"; outdoors {outdoor_default:g}" if outdoor_default else ""
        )
        help_text = f"{quantity.help_or_placeholder}  [default: {default_text}]"
        option_type = NumberWithUnit(quantity.unit)
        command = click.option(quantity.option, field, type=option_type, help=help_text)(command)
    return command


class CommandWithFaultTable(click.Command):
    """Command whose help ends with a table of the faults that can be injected."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Add a table of the fault names, with usage, description and default value, to --help."""
        with formatter.section(
            "Injected faults for --mistake [brackets contain the default VALUE]"
        ):
            formatter.write_dl(
                [
                    (
                        f"{name}{mistake.usage}",
                        mistake.help
                        + (f" [{mistake.default:g}]" if mistake.value_field_names else ""),
                    )
                    for name, mistake in FAULT_TYPES.items()
                ]
            )


@click.command(cls=CommandWithFaultTable)
@output_option(
    "FLIGHT.ulg|DIR",
    "Log to write (ULog); with --assignment, folder for the logs.",
    required=True,
)
@input_option(
    "--assignment",
    "ROSTER.csv",
    "Class list (student id, name): writes an answer key next to DIR, and one flight per student "
    "with random noise and faults.",
)
@input_option(
    "--secret-file",
    "FILE",
    "Secret of --assignment: the same secret and student id give the same flight.  [default: "
    "generated, and stored in the answer key]",
)
@click.option(
    "--mistakes",
    "fault_count",
    type=int,
    metavar="N",
    help="Number of faults in each flight of --assignment.  [default: random, 0 to 2]",
)
@click.option(
    "--kind",
    type=Choice((*get_args(ScenarioKind), MIXED_KIND)),
    default=_DEFAULT_SCENARIO.kind,
    help="aisle: passes along a straight path with UWB; loop: laps of a square with drifting VIO; "
    "outdoor: laps of a square with GNSS; mixed (with --assignment): loop for one third of the "
    "students, aisle for the others.",
)
@click.option(
    "--seed",
    type=int,
    metavar="N",
    default=_DEFAULT_SCENARIO.seed,
    help="Seed: the same N gives the same flight.",
)
@click.option(
    "--mistake",
    "fault_texts",
    metavar="NAME[=VALUE]",
    multiple=True,
    help="Injected fault, from the table below; repeatable.  [default: none]",
)
@click.option(
    "--answer",
    "answer_key_path",
    type=NonEmptyPath(),
    metavar="FILE.json",
    help="Answer key to write (injected faults, biases, outliers, clock offset), not for "
    "students.  [default with --assignment: DIR_answers.json]",
)
@flag_option("--no-truth", help="Write no ground truth to the log.")
@flag_option("--no-ekf2", help="Do not simulate EKF2, to save time.")
@click.option(
    "--passes",
    type=int,
    metavar="N",
    help="Number of passes of the straight path, or laps of the square.  [default: 6 passes, 1 "
    "lap; outdoors 3 laps]",
)
@click.option(
    "--yaw",
    type=Choice(get_args(YawMode)),
    help="Heading: fixed, or follow the flight direction.  [default: fixed, but follow "
    "on a square path]",
)
@_add_scenario_options
def simulate(
    output: Path,
    *,
    assignment: Path | None,
    secret_file: Path | None,
    fault_count: int | None,
    fault_texts: tuple[str, ...],
    answer_key_path: Path | None,
    no_truth: bool,
    no_ekf2: bool,
    kind: Any,
    **option_values: Any,
) -> None:
    """Simulate a flight with ground truth and injected faults.

    Writes a PX4 ULog for exercises and exams, with ground truth unless --no-truth. The log states
    that it is simulated, but not its injected faults. The EKF2 data in the log are from
    px4fuse's model of EKF2, not from PX4's code.

    For example, px4fuse simulate -o s07.ulg --seed 7 --mistake nlos=5% --answer s07.json

    With --assignment, writes one flight per student:
    px4fuse simulate --assignment roster.csv -o flights
    """
    _check_options(assignment, kind)
    if assignment is not None:
        _write_assignment(
            assignment, output, answer_key_path, secret_file, kind, fault_count, not no_truth
        )
        return
    if output.suffix.lower() != ".ulg":
        raise OutputError(f"{output}: the output is a ULog. Give a name ending in .ulg (-o).")
    check_output_paths([output, answer_key_path])
    fault_sizes = parse_faults(fault_texts)
    scenario = make_scenario(
        kind,
        truth=not no_truth,
        ekf2=not no_ekf2,
        **{name: value for name, value in option_values.items() if value is not None},
    )
    from px4fuse.results.contract import to_json
    from px4fuse.simulation import flights, terminal

    with progress() as show_progress:
        show_progress("simulating")
        simulation = flights.simulate(scenario, fault_sizes)
        show_progress("writing the log")
        contents = {output: flights.to_ulog(simulation)}
    if answer_key_path is not None:
        contents[answer_key_path] = to_json(flights.make_answer_key(simulation)).encode()
    write_and_print_results(contents, terminal.summary(simulation, answer_key_path))


def _check_options(assignment: Path | None, kind: str) -> None:
    """Reject options that cannot be combined with --assignment, or that need it."""
    if assignment is not None and kind == OUTDOOR_KIND:
        raise SettingsError(
            f"--kind {OUTDOOR_KIND} is not available with --assignment.",
            f"Use --kind aisle, loop or {MIXED_KIND}.",
        )
    if assignment is None and kind == MIXED_KIND:
        raise SettingsError(f"--kind {MIXED_KIND} requires --assignment ROSTER.csv.")
    for parameter in list_given_parameters():
        option = parameter.opts[0]
        if assignment is not None and parameter.name not in ASSIGNMENT_OPTIONS:
            raise SettingsError(
                f"{option} is not available with --assignment: the flights are random",
                f"Omit {option}.",
            )
        if assignment is None and parameter.name in ASSIGNMENT_ONLY_OPTIONS:
            raise SettingsError(f"{option} requires --assignment ROSTER.csv.")


def _write_assignment(
    roster: Path,
    folder: Path,
    requested_answer_key_path: Path | None,
    secret_file: Path | None,
    scenario_kind: Any,
    fault_count: int | None,
    with_ground_truth: bool,
) -> None:
    """Simulate a flight for each student of a class list, and write logs, forms and answer key."""
    from px4fuse.classroom.assignment import assignment
    from px4fuse.classroom.assignment.random_assignment import derive_seed_from_secret
    from px4fuse.classroom.assignment.roster import read_roster
    from px4fuse.classroom.terminal import assignment_page

    secret = None
    if secret_file is not None:
        option_text = f"--secret-file {secret_file}"
        secret_text = read_text(
            secret_file,
            SettingsError,
            MAX_SECRET_BYTES,
            name=option_text,
            remedy_if_too_large="Give a file with the secret as one line of text.",
        )
        secret = derive_seed_from_secret(secret_text, option_text)
    students = read_roster(roster)
    answer_key_path = assignment.answer_key_path(folder, requested_answer_key_path)
    check_output_paths([answer_key_path])
    check_output_folder(folder)
    with progress() as show_progress:
        key, written_flight_count = assignment.write_assignment(
            students,
            folder,
            answer_key_path,
            secret,
            scenario_kind,
            fault_count,
            with_ground_truth,
            partial(show_progress, "simulating"),
        )
    write_and_print_results({}, assignment_page(key, folder, answer_key_path, written_flight_count))
