"""``px4fuse whatif``: what EKF2 would have done with other parameters."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from px4fuse.cli import inputs, outputs
from px4fuse.errors import SettingsError
from px4fuse.units import NAMES, in_unit

if TYPE_CHECKING:
    from px4fuse.request import Sweep


@click.command()
@click.argument("log", type=inputs.InputPath())
@inputs.options("whatif", since={"type": inputs.TypedQuantity("s", 60.0)})
@inputs.flight_options
@inputs.report_options("A page, and its results beside it.")
@inputs.open_option
def whatif(
    log: Path,
    changes: tuple[str, ...],
    sweep: str | None,
    without: tuple[str, ...],
    since: float | None,
    output: Path | None,
    json_path: Path | None,
    **option_values: Any,
) -> None:
    """Replay EKF2 from LOG as flown and with other parameters, side by side.

    By a model of EKF2 that is started from the log, and believed only where it reproduces what EKF2
    logged. For example, px4fuse whatif log.ulg --set EKF2_EVP_NOISE=0.1. Without
    --set, --sweep and --without, with the measurement noise and the delay that the data ask for
    (see tune and sync). --without gnss_pos --from 60 goes on from there without that aid.
    """
    from px4fuse.analysis import run_what_if
    from px4fuse.report.whatif import summary
    from px4fuse.request import WhatIfRequest
    from px4fuse.results.build import whatif_results

    outputs.report_paths(output, json_path)  # before the work, not after it
    if since is not None and not without:
        raise SettingsError("--from says when --without begins: give that too.")
    request = WhatIfRequest(
        log=str(log),
        changes=_parse_changes(changes),
        sweep=None if sweep is None else _parse_sweep(sweep),
        without=dict.fromkeys(without, since or 0.0),
        **option_values,
    )
    with outputs.progress(json_path) as step:
        counterfactual = run_what_if(request, step)
        results = whatif_results(request, counterfactual)
        contents = outputs.result_files(results, json_path, output, counterfactual, step)
    outputs.write_and_print(contents, summary(counterfactual))


def _parse_changes(texts: tuple[str, ...]) -> dict[str, float]:
    changes: dict[str, float] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise SettingsError(f"--set {text}: give NAME=VALUE, for example EKF2_EVP_NOISE=0.1.")
        if name in changes:
            raise SettingsError(f"--set {name} is given twice.")
        changes[name] = _parse_number(f"--set {text}", name, value)
    return changes


def _parse_sweep(text: str) -> Sweep:
    from px4fuse.request import Sweep

    name, _, ends = text.partition("=")
    limits = ends.split(":")
    if len(limits) not in (2, 3) or (len(limits) == 3 and not limits[2].isdecimal()):
        raise SettingsError.of("sweep_wrong", text=text)
    low, high = (_parse_number(f"--sweep {text}", name, limit) for limit in limits[:2])
    return Sweep(name, low, high, *map(int, limits[2:]))


def _parse_number(option_text: str, name: str, value: str) -> float:
    from px4fuse.ekf2_parameters import PARAMETERS

    try:
        return float(value)
    except ValueError as error:
        unit = PARAMETERS[name].unit.replace("^2", "²") if name in PARAMETERS else ""
        parsed = in_unit(value, unit)
        problem = " is not a number" if parsed is None else f": give {NAMES[unit]}, as {parsed:g}"
        raise SettingsError(f"{option_text}: {value!r}{problem}.") from error
