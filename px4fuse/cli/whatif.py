"""Command ``px4fuse whatif``: replays EKF2 with changed parameters."""

from pathlib import Path
from typing import Any

import click

from px4fuse.cli import options, outputs
from px4fuse.core.units import UNIT_NAMES, convert_to_unit
from px4fuse.errors import SettingsError
from px4fuse.request import Sweep, WhatIfRequest


@click.command()
@options.log_argument
@click.option(
    "--set",
    "parameter_texts",
    metavar="NAME=VALUE",
    multiple=True,
    help="EKF2 parameter and its value in the replay, in PX4's unit; repeatable.  [default: the "
    "maximum-likelihood noise and delay of the position source]",
)
@click.option(
    "--sweep",
    metavar="NAME=LOW:HIGH[:COUNT]",
    help="Replay EKF2 with COUNT values of one parameter, from LOW to HIGH in PX4's unit.  "
    "[default COUNT: 9]",
)
@click.option(
    "--without",
    metavar="AID",
    multiple=True,
    help="Aiding source that EKF2 does not fuse in the replay, for example gnss_pos, gnss_vel, "
    "baro_hgt, mag or ev_pos; repeatable.",
)
@click.option(
    "--from",
    "start_s",
    type=options.NumberWithUnit("s", 60.0),
    metavar="SECONDS",
    help="Time (s after the first sample) at which EKF2 stops fusing the aiding sources given "
    "with --without.  [default: 0]",
)
@options.system_option
@options.max_size_option
@options.json_option
def whatif(
    log: Path,
    parameter_texts: tuple[str, ...],
    sweep: str | None,
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
    request = WhatIfRequest(
        log=str(log),
        changes=_parse_parameters(parameter_texts),
        sweep=None if sweep is None else _parse_sweep(sweep),
        without=dict.fromkeys(without, start_s or 0.0),
        **option_values,
    )
    with outputs.progress(json_path) as show_progress:
        analysis = run_what_if(request, show_progress)
    results = make_whatif_results(request, analysis)
    outputs.write_and_print_results(
        outputs.make_result_files(results, json_path), make_whatif_page(analysis)
    )


def _parse_parameters(parameter_texts: tuple[str, ...]) -> dict[str, float]:
    value_by_name: dict[str, float] = {}
    for text in parameter_texts:
        name, separator, value = text.partition("=")
        if not separator:
            raise SettingsError(
                f"--set {text} is not NAME=VALUE. Give for example --set EKF2_EVP_NOISE=0.1."
            )
        if name in value_by_name:
            raise SettingsError(f"--set {name} is given twice. Give each parameter once.")
        value_by_name[name] = _parse_number(f"--set {text}", name, value)
    return value_by_name


def _parse_sweep(text: str) -> Sweep:
    parameter_name, _, range_text = text.partition("=")
    range_fields = range_text.split(":")
    if len(range_fields) not in (2, 3) or (
        len(range_fields) == 3 and not range_fields[2].isdecimal()
    ):
        raise SettingsError(
            f"--sweep {text} is not valid. Use NAME=LOW:HIGH or NAME=LOW:HIGH:COUNT, for "
            "example EKF2_EVP_NOISE=0.02:0.5."
        )
    low, high = (
        _parse_number(f"--sweep {text}", parameter_name, field) for field in range_fields[:2]
    )
    return Sweep(parameter_name, low, high, *map(int, range_fields[2:]))


def _parse_number(option_text: str, name: str, value: str) -> float:
    from px4fuse.flight.ekf2_parameters import PARAMETERS

    try:
        return float(value)
    except ValueError as error:
        advice_text = ""
        unit = PARAMETERS[name].printed_unit if name in PARAMETERS else ""
        if unit and (number := convert_to_unit(value, unit)) is not None:
            advice_text = f" in {UNIT_NAMES.get(unit, unit)}. Give {number:g}"
        raise SettingsError(f"{option_text}: {value!r} is not a number{advice_text}.") from error
