"""Messages on wrong axes, unit and orientation of a position source: fault and remedy."""

from collections.abc import Sequence

from .axes import METRES_PER_UNIT
from .model import AxisDirections, Direction, Unit

# The opposite of each direction has the same index in the reversed tuple
DIRECTIONS: tuple[Direction, ...] = ("north", "east", "down", "up", "west", "south")
OPPOSITE_DIRECTION = dict(zip(DIRECTIONS, DIRECTIONS[::-1], strict=True))
FRAME_AXES: dict[str, AxisDirections] = {
    "NED": ("north", "east", "down"),
    "ENU": ("east", "north", "up"),
    "NWU": ("north", "west", "up"),
    "EUS": ("east", "up", "south"),
    "EDN": ("east", "down", "north"),
}
UNIT_NAMES: dict[Unit, str] = {
    "m": "metres",
    "cm": "centimetres",
    "mm": "millimetres",
    "feet": "feet",
}


def append_opposites(axes: AxisDirections) -> list[Direction]:
    """Return the directions of x, y, z, -z, -y, -x."""
    return [*axes, *(OPPOSITE_DIRECTION[direction] for direction in axes[::-1])]


def find_axes_in_file(axes: AxisDirections, frame: str) -> AxisDirections:
    """Return the true directions of the columns x, y, z of a position file.

    The file was converted to NED from an assumed frame, which may be wrong.

    Parameters
    ----------
    axes : tuple of Direction
        Directions in which x, y, z really point after the conversion from ``frame`` to NED. If
        ``frame`` is correct, they are north, east, down.
    frame : str
        Assumed frame of the file, from which the positions were converted, for example "ENU".
    """
    # True direction of each assumed direction. For example, a column that is up in ``frame``
    # becomes the -z axis of NED, so its true direction is the opposite of axes[2]
    true_directions = dict(zip(DIRECTIONS, append_opposites(axes), strict=True))
    x, y, z = (true_directions[name] for name in FRAME_AXES[frame])
    return x, y, z


def format_axes(axes: Sequence[str], unit: Unit) -> str:
    return "x {}, y {}, z {} ({})".format(*axes, UNIT_NAMES[unit])


def format_delay(late_s: float, decimals: int) -> str:
    """Format a delay of timestamps with its direction; "" for a delay that rounds to zero.

    >>> format_delay(0.52, 2), format_delay(-0.3, 1), format_delay(-0.04, 1)
    ('0.52 s late', '0.3 s early', '')
    """
    if not round(late_s, decimals):
        return ""
    return f"{abs(late_s):.{decimals}f} s {'late' if late_s > 0 else 'early'}"


def describe_axes(
    axes: AxisDirections, stated_frame: str, *, is_mirrored: bool, is_file: bool
) -> tuple[str, str]:
    """Describe wrong axes of a position source or file, and the action.

    >>> describe_axes(("east", "north", "up"), "NED", is_mirrored=False, is_file=True)
    ('ENU positions read as NED: x is east, y north, z up', 'Run again with --position-frame enu.')
    """
    x, y, z = axes
    frame_name = next((frame for frame in FRAME_AXES if FRAME_AXES[frame] == axes), "")
    title = f"The position axes are not {stated_frame}"
    if frame_name:
        title = f"{frame_name} positions {'read' if is_file else 'sent'} as {stated_frame}"
    fault = f"{title}: x is {x}, y {y}, z {z}{' (left-handed frame)' if is_mirrored else ''}"
    # Same order as append_opposites: for x east, y north, z up, the direction down is -z
    source_axis_by_direction = dict(
        zip(append_opposites(axes), ("x", "y", "z", "-z", "-y", "-x"), strict=True)
    )
    ned_text = ", ".join(
        f"{direction} = {source_axis_by_direction[direction]}" for direction in FRAME_AXES["NED"]
    )
    if is_file and frame_name:
        return fault, f"Run again with --position-frame {frame_name.lower()}."
    if is_file:
        return fault, f"Write {ned_text} to the file, and run again with --position-frame ned."
    if frame_name == "ENU":
        return fault, (
            "With MAVROS, publish the ENU positions on vision_pose/pose: MAVROS converts them to "
            f"NED. Without MAVROS, send {ned_text}."
        )
    return fault, f"Send {ned_text}."


def describe_wrong_unit(
    unit: Unit, positions: str, stated_unit: str = "metres", *, is_file: bool
) -> tuple[str, str]:
    """Describe a wrong length unit of a position source or file, and the action.

    >>> describe_wrong_unit("cm", "positions", is_file=True)
    ('positions are in centimetres, not in metres', 'Run again with --position-unit cm.')
    """
    fault = f"{positions} are in {UNIT_NAMES[unit]}, not in {stated_unit}"
    if is_file and unit != "feet":
        return fault, f"Run again with --position-unit {unit}."
    if is_file:
        return fault, f"Multiply x, y and z in the file by {METRES_PER_UNIT[unit]:g}."
    return fault, f"Multiply x, y and z by {METRES_PER_UNIT[unit]:g} before sending."


def describe_quaternion_conversion(frames: str) -> str:
    """Describe the conversion of a quaternion from other frames to FRD and NED.

    >>> describe_quaternion_conversion("FLU to NWU")
    'Convert the orientation: q_NED = (0, 1, 0, 0) ⊗ q ⊗ (0, 1, 0, 0), in the order w, x, y, z.'
    """
    left_quaternion_text = {"ENU": "(0, √½, √½, 0) ⊗ ", "NWU": "(0, 1, 0, 0) ⊗ "}.get(
        frames[-3:], ""
    )
    right_quaternion_text = " ⊗ (0, 1, 0, 0)" if frames.startswith("FLU") else ""
    return (
        f"Convert the orientation: q_NED = {left_quaternion_text}q{right_quaternion_text}, in the "
        "order w, x, y, z."
    )
