"""Faults of axes and unit in words, with the action for a sender or a position file."""

from px4fuse.convention.axes import UNITS, Axes
from px4fuse.convention.correction import DIRECTIONS

FRAME_AXES: dict[str, Axes] = {
    "NED": ("north", "east", "down"),
    "ENU": ("east", "north", "up"),
    "NWU": ("north", "west", "up"),
}
UNIT_NAMES = {"m": "metres", "cm": "centimetres", "mm": "millimetres", "feet": "feet"}


def opposite(direction: str) -> str:
    """Return the opposite direction.

    >>> opposite("north"), opposite("up")
    ('south', 'down')
    """
    negated = tuple(-value for value in DIRECTIONS[direction])
    return next(name for name, vector in DIRECTIONS.items() if vector == negated)


def axes_as_sent(axes: Axes, frame: str) -> Axes:
    """Return the directions of x, y, z of a file whose positions were converted from a frame.

    Parameters
    ----------
    axes : tuple of str
        Directions of the converted axes, which were taken for north, east, down.
    frame : {"NED", "ENU", "NWU"}
        Frame from which they were converted.
    """
    direction_by_name = dict(zip(FRAME_AXES["NED"], axes, strict=True))
    direction_by_name |= {
        opposite(name): opposite(direction) for name, direction in direction_by_name.items()
    }
    x, y, z = (direction_by_name[name] for name in FRAME_AXES[frame])
    return x, y, z


def describe_axes(axes: Axes, stated: str, *, is_mirrored: bool, is_file: bool) -> tuple[str, str]:
    """Return the fault of axes that are not the stated frame, and the action.

    >>> describe_axes(("east", "north", "up"), "NED", is_mirrored=False, is_file=True)
    ('ENU read as NED: x is east, y north, z up', 'Run again with --position-frame enu.')
    """
    x, y, z = axes
    name = next((frame for frame, known in FRAME_AXES.items() if known == axes), "")
    title = f"The axes are not {stated}"
    if name:
        title = f"{name} {'read' if is_file else 'sent'} as {stated}"
    elif z == "up" and is_mirrored:
        title = "z points up"
    elif (x, y, z) == ("east", "north", "down"):
        title = "x and y are exchanged"
    elif y == "up":
        title = "y points up"
    fault = f"{title}: x is {x}, y {y}, z {z}{' (left-handed frame)' if is_mirrored else ''}"
    columns = dict(zip(axes, "xyz", strict=True))
    columns |= {opposite(direction): f"-{column}" for direction, column in columns.items()}
    ned = ", ".join(columns[direction] for direction in FRAME_AXES["NED"])
    if is_file and name:
        return fault, f"Run again with --position-frame {name.lower()}."
    if is_file:
        return fault, f"Write (north, east, down) = ({ned}), and give --position-frame ned."
    action = f"Send (north, east, down) = ({ned})."
    if name == "ENU":
        action = (
            "MAVROS converts to NED: publish ENU and FLU on vision_pose/pose. Own sender or ROS 2: "
            f"send (north, east, down) = ({ned})."
        )
    return fault, action


def describe_unit(
    unit: str, positions: str, stated: str = "metres", *, is_file: bool
) -> tuple[str, str]:
    """Return the fault of a unit other than the stated one, and the action.

    >>> describe_unit("cm", "positions", is_file=True)
    ('positions are in centimetres, not in metres', 'Run again with --position-unit cm.')
    """
    fault = f"{positions} are in {UNIT_NAMES[unit]}, not in {stated}"
    if is_file and unit != "feet":
        return fault, f"Run again with --position-unit {unit}."
    where = "in the file" if is_file else "before they are sent"
    return fault, f"Multiply x, y and z by {UNITS[unit]:g} {where}."


def describe_conversion(frames: str) -> str:
    """Return the action for an orientation in other frames.

    >>> describe_conversion("FLU to NWU")
    'Convert the orientation: q_NED = (0, 1, 0, 0) ⊗ q ⊗ (0, 1, 0, 0), in the order w, x, y, z.'
    """
    body, _, world = frames.partition(" to ")
    left = {"ENU": "(0, √½, √½, 0) ⊗ ", "NWU": "(0, 1, 0, 0) ⊗ "}.get(world, "")
    right = " ⊗ (0, 1, 0, 0)" if body == "FLU" else ""
    return f"Convert the orientation: q_NED = {left}q{right}, in the order w, x, y, z."
