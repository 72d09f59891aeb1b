"""Command ``px4fuse whatif``: replays EKF2 with changed parameters."""

import re
from pathlib import Path
from typing import Any

import click

from px4fuse.errors import SettingsError
from px4fuse.request import Sweep, WhatIfRequest

from . import options, outputs

_SWEEP_PATTERN = re.compile("([^=]*)=([^:]*):([^:]*)(?::([0-9]+))?")


def _parse_number(parameter_name: str, text: str) -> Any:
    """Parse the value of an EKF2 parameter in the unit that PX4 uses for this parameter."""
    from px4fuse.flight.ekf2_parameters import MODEL_PARAMETERS

    unit = (
        MODEL_PARAMETERS[parameter_name].printed_unit if parameter_name in MODEL_PARAMETERS else ""
    )
    try:
        return options.NumberWithUnit(unit).convert(text, None, None)
    except click.BadParameter as error:
        raise click.BadParameter(f"{parameter_name}: {error.message}") from error


def parse_parameter(text: str) -> tuple[str, float]:
    """Parse a parameter and its value: ``NAME=VALUE``."""
    name, separator, value = text.partition("=")
    if not separator:
        raise click.BadParameter(f"{text} is not NAME=VALUE. Give for example EKF2_EVP_NOISE=0.1.")
    return name, _parse_number(name, value)


def parse_sweep(text: str) -> Sweep:
    """Parse the range of a parameter: ``NAME=LOW:HIGH`` or ``NAME=LOW:HIGH:COUNT``."""
    match = _SWEEP_PATTERN.fullmatch(text)
    if match is None:
        raise click.BadParameter(
            f"{text} is not NAME=LOW:HIGH or NAME=LOW:HIGH:COUNT. Give for example "
            "EKF2_EVP_NOISE=0.02:0.5."
        )
    name, *limits, count = match.groups()
    low, high = (_parse_number(name, limit) for limit in limits)
    return Sweep(name, low, high) if count is None else Sweep(name, low, high, int(count))


@click.command()
@options.log_argument
@click.option(
    "--set",
    "parameters",
    type=parse_parameter,
    metavar="NAME=VALUE",
    multiple=True,
    help="EKF2 parameter in PX4's unit; repeatable.  [default: the maximum-likelihood noise and "
    "delay of the position source]",
)
@click.option(
    "--sweep",
    type=parse_sweep,
    metavar="NAME=LOW:HIGH[:COUNT]",
    help="Replay EKF2 with COUNT values of one parameter, from LOW to HIGH in PX4's unit.  "
    "[default COUNT: 9]",
)
@click.option(
    "--without",
    metavar="AID",
    multiple=True,
    help="Aiding source that EKF2 does not fuse, for example gnss_pos, gnss_vel, baro_hgt, mag or "
    "ev_pos; repeatable.",
)
@click.option(
    "--from",
    "start_s",
    type=options.NumberWithUnit("s"),
    metavar="SECONDS",
    help="Start of the time without AID (s after the first sample).  [default: 0]",
)
@options.system_option
@options.max_size_option
@options.json_option
def whatif(
    log: Path,
    parameters: tuple[tuple[str, float], ...],
    without: tuple[str, ...],
    start_s: float | None,
    json_path: Path | None,
    **option_values: Any,
) -> None:
    """Replay EKF2 with changed parameters.

    Replays EKF2 from LOG with the parameters as flown and with changed ones, and compares the
    results. Uses px4fuse's model of EKF2, and prints results only if the model reproduces the
    logged innovations. For example, px4fuse whatif log.ulg --set EKF2_EVP_NOISE=0.1. Without
    --set, --sweep and --without, the changes are the maximum-likelihood noise and delay (see
    px4fuse tune and px4fuse sync). --without gnss_pos --from 60 omits the GNSS positions from 60 s
    on.
    """
    from px4fuse.diagnose import run_what_if
    from px4fuse.report.whatif import make_whatif_page
    from px4fuse.results.build import make_whatif_results

    if start_s is not None and not without:
        raise SettingsError("--from requires --without AID.")
    changes: dict[str, float] = {}
    for name, value in parameters:
        if name in changes:
            raise SettingsError(f"--set {name} is given twice. Give each parameter once.")
        changes[name] = value
    request = WhatIfRequest(
        log=str(log),
        changes=changes,
        without=dict.fromkeys(without, start_s or 0.0),
        **option_values,
    )
    with outputs.progress(json_path) as show_progress:
        analysis = run_what_if(request, show_progress)
    results = make_whatif_results(request, analysis)
    outputs.write_and_print_results(
        outputs.make_result_files(results, json_path), make_whatif_page(analysis)
    )
