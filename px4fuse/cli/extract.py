"""Command ``px4fuse extract``: exports a log as tables."""

import importlib.util
import json
from pathlib import Path
from typing import Any

import click

from px4fuse.core.input_files import check_output_folder, protect_inputs
from px4fuse.core.reading import read_text
from px4fuse.errors import OutputError, to_one_line

from .options import (
    Choice,
    comparison_request,
    flight_options,
    log_argument,
    output_option,
)
from .outputs import write_outputs

# Maximum size (bytes) of the flight.json of an earlier export
MAX_DESCRIPTION_BYTES = 50_000_000


@click.command()
@log_argument
@output_option("DIR", "Output folder for the tables.", required=True)
@click.option(
    "--format",
    type=Choice(("csv", "parquet")),
    default="csv",
    help='File format of the tables; parquet requires pip install "px4fuse[parquet]".',
)
@flight_options
def extract(
    log: Path,
    output: Path,
    format: str,  # noqa: A002 - name of the option
    **option_values: Any,
) -> None:
    """Export a log as tables (CSV or Parquet).

    Writes one table per data type, and flight.json (log, topics, clocks and missing data). The
    names of columns contain the units: north_m_s2 is in m/s², north_m2 in m². time_s is the time
    since the first sample. Axes are north, east and down, or forward, right and down (body).
    """
    check_output_folder(output)
    if format == "parquet" and importlib.util.find_spec("pyarrow") is None:
        raise OutputError(
            '--format parquet requires pyarrow. Run pip install "px4fuse[parquet]", or '
            "use --format csv."
        )
    from px4fuse.diagnose import read_flight
    from px4fuse.info import tables as extraction
    from px4fuse.results.contract import to_json

    flight = extraction.add_source_innovations(read_flight(comparison_request(log, option_values)))
    _require_same_flight(output, flight.log.sha256)
    tables = {f"{name}.{format}": table for name, table in extraction.tables(flight).items()}
    contents = {
        output / file_name: extraction.to_bytes(table, format)
        for file_name, table in tables.items()
    }
    contents[output / "flight.json"] = to_json(extraction.describe_flight(flight)).encode()
    write_outputs(contents)
    click.echo(f"Wrote to {to_one_line(str(output))}:")
    for file_name, table in tables.items():
        click.echo(f"  {file_name:44} {len(table):8} rows")
    click.echo("  flight.json")
    for missing_part in extraction.list_missing_data(flight):
        click.echo(f"Not exported: {missing_part.what} ({missing_part.reason})")


def _require_same_flight(folder: Path, sha256: str) -> None:
    """Raise ``OutputError`` if a folder already contains the tables of another log."""
    try:
        with protect_inputs(is_active=False):
            text = read_text(folder / "flight.json", OutputError, MAX_DESCRIPTION_BYTES)
        earlier_log = json.loads(text)["log"]
        earlier_name, earlier_sha256 = earlier_log["name"], earlier_log["sha256"]
    # without a valid flight.json, assume that the folder contains no tables of another log
    except (OutputError, ValueError, KeyError, TypeError):
        return
    if earlier_sha256 != sha256:
        raise OutputError(
            f"{folder} contains the tables of another log, {earlier_name}. Choose "
            "another folder (-o)."
        )
