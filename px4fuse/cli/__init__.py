"""The command line: parses and prints; it computes nothing."""

import atexit
import errno
import gc
import importlib
import os
import signal
import sys
from pathlib import Path

import click

from px4fuse.cli.outputs import Interrupted, written_so_far
from px4fuse.errors import OutputError, Px4FuseError, SettingsError, to_one_line
from px4fuse.input_files import inputs_protected
from px4fuse.threads import ONE_THREAD

# Commands, each in a module of its name, and their help: --help must not import what they need
COMMANDS = {
    "compare": "Compare a flight's EKF2 with a two-state Kalman filter.",
    "batch": "Compare many logs, on this computer or a cluster.",
    "diff": "List differences between two flights or two settings.",
    "answers": "Write the form about a flight, to be filled in.",
    "explore": "Turn the filter's knobs on a flight, in a web page.",
    "practice": "Find what is wrong with simulated flights, in a web page.",
    "info": "Say what is in a log and what can be done with it.",
    "explain": "Explain a finding: meaning, example, action, false alarms.",
    "extract": "Write a log's data as tidy tables, CSV or Parquet.",
    "tune": "Find the noises that the data ask for, with intervals.",
    "sync": "Estimate the position source's clock offset.",
    "whatif": "Say what EKF2 would have done with other parameters.",
    "loop": "Measure and correct the closure error of a loop.",
    "evaluate": "Score a trajectory: ATE and RPE against a reference.",
    "simulate": "Simulate a flight with chosen mistakes, as ULog.",
    "verify": "Check a report against its log, number by number.",
    "grade": "Verify and score a class's reports.",
    "sample": "Write the sample flights, to try things on.",
    "lesson": "Run the lesson's worked examples through this engine.",
}


#: Signals that end a run: Ctrl-C, termination, and (not on Windows) a closed terminal
STOPPING = (signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []))

HELP = ["-h", "--help"]
# Variables that stop matplotlib and pymavlink while they are imported if their value is wrong; no
# output depends on them: figures are SVG, and contain no date
UNUSED = ("MPLBACKEND", "SOURCE_DATE_EPOCH")
# Address space for the libraries and the sample's report, which takes 0.7 GB
LEAST_BYTES = 800_000_000

# pandas loads pyarrow wherever it is installed: 70 MB that only these need
PARQUET_COMMANDS = ("batch", "extract")


class LazyGroup(click.Group):
    """A group whose commands are imported when they are called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names of all commands."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import one command."""
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f"px4fuse.cli.{cmd_name}")
        command: click.Command = getattr(module, cmd_name)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command; what is nearly one, or a file without one, is told how to be typed."""
        name = args[0]
        if name not in COMMANDS and not name.startswith("-"):
            import difflib
            import shlex

            message = f"No such command {name!r}."
            if close_matches := difflib.get_close_matches(name.lower(), COMMANDS):
                message += f" Did you mean {close_matches[0]!r}?"
            elif Path(name).is_file():
                message = f"Say what to do with it: {shlex.join(['px4fuse', 'compare', *args])}."
            ctx.fail(message)
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> object:
        """Invoke a command; what ends it early is told apart before click sees it."""
        try:
            with inputs_protected():
                return super().invoke(ctx)
        except Px4FuseError as error:
            error.args = (_with_option_names(str(error), ctx.invoked_subcommand),)
            raise
        except BrokenPipeError as error:
            # click itself ends with exit code 1 where it sees errno EPIPE
            raise BrokenPipeError from error
        except KeyboardInterrupt as stopped:  # click itself would print an empty line
            raise Interrupted(stopped, written_so_far(ctx)) from None
        except MemoryError as error:
            raise _system_error(OSError(errno.ENOMEM, ""), written_so_far(ctx)) from error
        except OSError as error:
            raise _system_error(error, written_so_far(ctx)) from error

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands from the table above, without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))


@click.group(cls=LazyGroup, context_settings={"help_option_names": HELP, "show_default": True})
@click.version_option(package_name="px4fuse")
def cli() -> None:
    """Replay a PX4 flight through a two-state Kalman filter and compare it with EKF2.

    For example, px4fuse compare log.ulg writes reports/log.pdf and reports/log.json.
    """


def _system_error(error: OSError, written: str) -> Px4FuseError:
    """Error of a system call, with its cause."""
    if error.errno == errno.ENOMEM:
        return Px4FuseError(
            f"not enough memory, {written}", "Close other programs, or raise the limit (ulimit -v)."
        )
    try:
        Path.cwd()
    except OSError:
        return SettingsError(
            f"the current folder no longer exists, {written}", "Change to another folder."
        )
    if error.filename is not None:
        return OutputError(f"{error.filename}: cannot be used ({error.strerror}), {written}")
    return OutputError(f"standard output: cannot be written ({error.strerror}), {written}")


def _check_memory() -> None:
    """Refuse a limit under which libraries end the process without a message."""
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < LEAST_BYTES:
        raise SettingsError(
            f"the memory limit is {limit / 1e6:.0f} MB, at least {LEAST_BYTES / 1e6:.0f} MB of "
            "address space are required",
            "Raise it, for example with ulimit -v unlimited.",
        )


def main() -> None:
    """Run the command line; bad input is one line on standard error and exit code 2."""
    # one short job per process: looking for garbage while importing and drawing costs a tenth
    gc.disable()
    atexit.register(gc.freeze)  # and while everything is thrown away, as much again
    _prepare_libraries()
    _open_streams()
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # σ and ν on a Windows console with a legacy code page
            stream.reconfigure(errors="replace")
    for number in STOPPING:
        if signal.getsignal(number) is signal.SIG_DFL:  # not where nohup ignores it
            signal.signal(number, _interrupt)
    try:
        if not {*HELP, "--version"} & set(sys.argv):
            _check_memory()
        code = cli.main(standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        code = 2
    except click.UsageError as error:
        command_name = error.ctx.command_path if error.ctx else "px4fuse"
        _print_error(f"{error.format_message()} See {command_name} --help.")
        code = 2
    except Px4FuseError as error:
        _print_error(str(error))
        code = 2
    except Interrupted as stopped:
        _print_error(str(stopped))
        code = stopped.exit_code
    except BrokenPipeError:  # the reader of a pipe has gone, as with | head; the files are written
        _abandon_output()
        code = 0
    except OSError as error:  # of --help and --version, which click writes itself
        _print_error(f"standard output: cannot be written ({error.strerror}), nothing was written.")
        code = 2
    sys.exit(_flush_output(code if isinstance(code, int) else 0))


def _prepare_libraries() -> None:
    """Set what libraries read when commands import them later."""
    for name, one in ONE_THREAD.items():
        os.environ.setdefault(name, one)
    for name in UNUSED:
        os.environ.pop(name, None)
    if not set(PARQUET_COMMANDS) & set(sys.argv[1:2]):
        sys.modules.setdefault("pyarrow", None)  # type: ignore[arg-type]  # as if there were none


def _flush_output(code: int) -> int:
    """The exit code once all that was said is out."""
    try:
        sys.stdout.flush()
    except OSError as error:
        _abandon_output()
        if code == 0:  # else said before
            _print_error(f"standard output: cannot be written ({error.strerror}).")
            return 2
    return code


def _open_streams() -> None:
    """Give a stream that was closed (``>&-``) a place where what is written is lost."""
    for number, name in ((1, "stdout"), (2, "stderr")):
        if getattr(sys, name) is None:
            null_device = os.open(os.devnull, os.O_WRONLY)
            if null_device != number:
                os.dup2(null_device, number)
                os.close(null_device)
            setattr(sys, name, open(number, "w", encoding="utf-8"))  # noqa: SIM115, PTH123 - for good


def _with_option_names(text: str, command: str | None) -> str:
    """The text of an error as somebody who typed a command reads it."""
    from px4fuse.request import EVALUATION_OPTIONS, LOOP_OPTIONS, OPTIONS, with_options

    tables = {"loop": LOOP_OPTIONS, "evaluate": EVALUATION_OPTIONS}
    return with_options(text, tables.get(command or "", OPTIONS))


def _print_error(text: str) -> None:
    click.echo(f"px4fuse: {to_one_line(text)}", err=True)


def _interrupt(number: int, _: object) -> None:
    """End the run by termination as by Ctrl-C, so that it clears up."""
    raise KeyboardInterrupt(number)


def _abandon_output() -> None:
    """Send what is still buffered nowhere, so that Python does not complain at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
