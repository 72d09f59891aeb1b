"""Command line of px4fuse: parses the arguments and prints results, without computations."""

import atexit
import errno
import gc
import importlib
import logging
import os
import shlex
import signal
import sys
from pathlib import Path

import click

from px4fuse.core.input_files import protect_inputs
from px4fuse.core.threads import ONE_THREAD_ENVIRONMENT
from px4fuse.errors import OutputError, Px4FuseError, SettingsError, suggest_name, to_one_line
from px4fuse.request import (
    COMPARISON_OPTIONS,
    OPTION_NAMES,
    EvaluationRequest,
    LoopRequest,
    replace_argument_names,
)

from .outputs import Interrupted, describe_written_files

# Commands in the order of --help; command NAME is the function NAME in cli/NAME.py
COMMANDS = (
    "compare",
    "batch",
    "diff",
    "answers",
    "explore",
    "practice",
    "info",
    "explain",
    "extract",
    "tune",
    "sync",
    "whatif",
    "loop",
    "evaluate",
    "simulate",
    "verify",
    "grade",
    "sample",
    "mcp",
    "lesson",
)


#: Signals that end a run: Ctrl-C, termination, and a closed terminal (except on Windows)
TERMINATION_SIGNALS = (
    signal.SIGINT,
    signal.SIGTERM,
    *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []),
)

# Environment variables that px4fuse removes: with invalid values, libraries cannot be imported
IGNORED_ENVIRONMENT_VARIABLES = ("MPLBACKEND", "SOURCE_DATE_EPOCH")
# Command-line option of each Python argument, for error messages. Commands that are not listed use
# the options of px4fuse compare
OPTION_NAMES_BY_COMMAND = {
    "loop": OPTION_NAMES[LoopRequest],
    "evaluate": OPTION_NAMES[EvaluationRequest],
}
# Commands that need pyarrow; other commands do not import it, which saves 70 MB of memory
COMMANDS_THAT_NEED_PYARROW = ("batch", "extract")


class LazyCommandGroup(click.Group):
    """Commands of px4fuse; the module of a command is imported when the command runs."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        return find_command(cmd_name) if cmd_name in COMMANDS else None

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command; for an unknown name, fail with a suggestion."""
        name = args[0]
        if name not in COMMANDS and not name.startswith("-"):
            message = f"Unknown command {name!r}. {suggest_name(name.lower(), COMMANDS)}"
            if Path(name).is_file():
                command = shlex.join(["px4fuse", "compare", *args])
                message = f"{name!r} is a file, not a command. Did you mean: {command}?"
            ctx.fail(message.rstrip())
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> object:
        """Run a command; convert system errors and Ctrl-C to exceptions of px4fuse."""
        try:
            with protect_inputs():
                return super().invoke(ctx)
        except Px4FuseError as error:
            option_names = OPTION_NAMES_BY_COMMAND.get(
                ctx.invoked_subcommand or "", COMPARISON_OPTIONS
            )
            error.args = (replace_argument_names(str(error), option_names),)
            raise
        except BrokenPipeError as error:
            # the new error has no errno, because click would end with exit code 1 for EPIPE
            raise BrokenPipeError from error
        except KeyboardInterrupt as interrupt:  # click's own handler prints an empty line
            raise Interrupted(interrupt, describe_written_files(ctx)) from None
        except (MemoryError, OSError) as error:
            raise _make_system_error(error, describe_written_files(ctx)) from error

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, help_text(name)) for name in COMMANDS])


def find_command(name: str) -> click.Command:
    command: click.Command = getattr(importlib.import_module(f"px4fuse.cli.{name}"), name)
    return command


def help_text(name: str) -> str:
    """Return the first sentence of the help of a command."""
    return find_command(name).get_short_help_str(limit=100)


@click.group(
    cls=LazyCommandGroup,
    context_settings={
        "help_option_names": ["-h", "--help"],
        "max_content_width": 100,
        "show_default": True,
    },
)
@click.version_option(package_name="px4fuse")
def cli() -> None:
    """Analyse PX4 flight logs: compare EKF2 with a two-state Kalman filter (KF).

    For example, px4fuse compare log.ulg writes reports/log.pdf and reports/log.json.
    """


def _make_system_error(error: MemoryError | OSError, files_sentence: str) -> Px4FuseError:
    """Convert an error of the operating system to an error with a remedy."""
    if isinstance(error, MemoryError) or error.errno == errno.ENOMEM:
        return Px4FuseError(
            f"not enough memory; {files_sentence}",
            "Close other programs, or raise the memory limit (ulimit -v).",
        )
    try:
        Path.cwd()
    except OSError:
        return SettingsError(
            f"the current folder no longer exists; {files_sentence}",
            "Change to an existing folder.",
        )
    if error.filename is not None:
        return OutputError(
            f"The file {error.filename} cannot be used ({error.strerror}); {files_sentence}"
        )
    return OutputError(f"standard output cannot be written ({error.strerror}); {files_sentence}")


def main() -> None:
    """Run the command line; print an error as one line on standard error, and exit with code 2."""
    # garbage collection needs 10 % of the run time of a short command
    gc.disable()
    atexit.register(gc.freeze)
    _configure_libraries()
    _redirect_closed_streams()
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # old Windows code pages lack σ and ν
            stream.reconfigure(errors="replace")
    for signal_number in TERMINATION_SIGNALS:
        if signal.getsignal(signal_number) is signal.SIG_DFL:  # under nohup, SIGHUP is ignored
            signal.signal(signal_number, _raise_interrupt)
    exit_code: object = 2  # unless the command ends without an error
    try:
        exit_code = cli.main(standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
    except click.UsageError as error:
        command_name = error.ctx.command_path if error.ctx else "px4fuse"
        _print_error(f"{error.format_message()} See {command_name} --help.")
    except (Px4FuseError, Interrupted) as error:
        _print_error(str(error))
        exit_code = getattr(error, "exit_code", 2)
    except BrokenPipeError:  # the program that reads the pipe has ended
        _discard_output()
        exit_code = 0
    except OSError as error:  # click cannot print --help or --version
        _print_error(f"standard output cannot be written ({error.strerror}); nothing was written.")
    sys.exit(_flush_output(exit_code if isinstance(exit_code, int) else 0))


def _configure_libraries() -> None:
    """Limit libraries to one thread, and avoid slow imports and warnings without effect."""
    for name, value in ONE_THREAD_ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    for name in IGNORED_ENVIRONMENT_VARIABLES:
        os.environ.pop(name, None)
    # matplotlib warns if the home folder is read-only, which has no effect on px4fuse
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    if not set(COMMANDS_THAT_NEED_PYARROW) & set(sys.argv[1:2]):
        # with this entry, pandas does not import pyarrow, which needs 70 MB
        sys.modules.setdefault("pyarrow", None)  # type: ignore[arg-type]


def _flush_output(exit_code: int) -> int:
    """Flush standard output; return 2 if this fails, otherwise ``exit_code``."""
    try:
        sys.stdout.flush()
    except OSError as error:
        _discard_output()
        if exit_code == 0:  # with another exit code, px4fuse has already printed an error
            _print_error(f"standard output cannot be written ({error.strerror}).")
            return 2
    return exit_code


def _redirect_closed_streams() -> None:
    """Redirect a closed standard stream (``>&-``) to the null device."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115 - must stay open


def _print_error(text: str) -> None:
    click.echo(f"px4fuse: {to_one_line(text)}", err=True)


def _raise_interrupt(signal_number: int, _: object) -> None:
    # end px4fuse as after Ctrl-C, so that temporary files are deleted
    raise KeyboardInterrupt(signal_number)


def _discard_output() -> None:
    # without this redirection, Python flushes the closed stream at exit and prints an error
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
