"""Commands in remedies, as they run when pasted.

Words are made without knowing where the log lies, and a report names no folder. So they write
``px4fuse compare LOG --sigma-z 0.2``, and the terminal puts in what was typed.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from msgspec.structs import replace

from px4fuse.request import (
    OPTIONS,
    ComparisonRequest,
    LoopRequest,
    Request,
    WhatIfRequest,
    command_line,
)

# A value ends before the full stop of its sentence
_WRITTEN = re.compile(r"px4fuse (\w+) LOG(?![\w.])((?: --[a-z-]+ [-\w]+(?:\.\d+)?)*)")
_FIELDS = {option.name: field for field, option in OPTIONS.items()}


def runnable(text: str, request: Request) -> tuple[str, list[str]]:
    """A text with its commands cut down to what they change, and the commands in full.

    Parameters
    ----------
    text : str
    request : Request
        What was typed: its files and options are those of the commands.

    Examples
    --------
    >>> runnable("px4fuse compare LOG --sigma-z 0.2: better.", ComparisonRequest(log="a b.ulg"))
    ('--sigma-z 0.2: better.', ["px4fuse compare 'a b.ulg' --sigma-z 0.2"])
    """
    commands = []
    for name, options in _WRITTEN.findall(text):
        words = options.split()
        values = zip(words[::2], words[1::2], strict=True)
        changes = {_FIELDS[option]: float(value) for option, value in values}
        commands.append(rerun(request, name, changes))
    short = _WRITTEN.sub(lambda found: found[2].strip() or f"px4fuse {found[1]}", text)
    return short, list(dict.fromkeys(commands))


def rerun(request: Request, command: str, changes: Mapping[str, float]) -> str:
    """A command on the files of a request, with its other options and some changed."""
    asked = request
    if isinstance(request, ComparisonRequest):
        if command == "loop":
            asked = LoopRequest(
                source=request.log,
                system=request.system,
                start_s=request.start_s,
                end_s=request.end_s,
            )
        elif command == "whatif":
            asked = WhatIfRequest(log=request.log, mavlink=request.mavlink, system=request.system)
    return command_line(replace(asked, **changes), command, typed=True)
