"""What somebody who works in a notebook meets: names, errors, results that show themselves."""

from __future__ import annotations

import pytest
from click.testing import CliRunner

import px4fuse
from px4fuse.cli import cli
from px4fuse.request import with_options


@pytest.mark.parametrize(
    ("arguments", "in_python", "on_the_command_line"),
    [
        ({"sigma_z_m": 0.0}, "`sigma_z_m` 0 is out", ("--sigma-z", "0")),
        ({"dt_s": 2.0}, "`dt_s` 2 is out", ("--dt", "2")),
        ({"clock_offset_s": 99.0}, "`clock_offset_s` 99 is out", ("--clock-offset", "99")),
    ],
)
def test_errors_name_arguments_in_python_and_options_on_the_command_line(
    arguments, in_python, on_the_command_line, sample_log
):
    with pytest.raises(px4fuse.Px4FuseError) as raised:
        px4fuse.Settings(**arguments)
    assert str(raised.value).startswith(in_python)
    result = CliRunner().invoke(cli, ["tune", str(sample_log), *on_the_command_line])
    option, value = on_the_command_line
    assert str(result.exception).startswith(f"{option} {value} is out of range")
    assert "`" not in str(result.exception)


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("loop {vio} --from 50 --to 40", "Change --from or --to."),
        ("loop {vio} --drift 0", "--drift 0 is outside"),
        ("loop {vio} --heading-drift 0", "--heading-drift 0 is outside"),
        ("loop {vio} --key-frames 0", "--key-frames 0 is outside"),
        ("loop {vio} --landed-at 1,1 --open", "--landed-at and --open exclude"),
        ("loop {vio} --frame ned", "--frame ned is for trajectory files"),
        ("compare {ulg} --system 1", "--system is for MAVLink"),
        ("compare {ulg} --heading nan", "--heading nan is not"),
        ("compare {ulg} --mavlink {ulg}", "--mavlink aisle_uwb.ulg: this is a ULog"),
        ("evaluate {vio}:vio {slam} --time-offset 9e5", "give --time-offset auto"),
    ],
)
def test_every_command_translates_to_its_own_options(typed, said, sample_log):
    folder = sample_log.parent
    words = typed.format(
        ulg=sample_log, vio=folder / "loop_vio.ulg", slam=folder / "loop_slam.tum"
    ).split()
    error = str(CliRunner().invoke(cli, words).exception)
    assert said in error
    assert "`" not in error


def test_only_arguments_are_translated():
    text = "`my log`.ulg: `no_argument` and `dt_s`"
    assert with_options(text) == "`my log`.ulg: `no_argument` and --dt"
