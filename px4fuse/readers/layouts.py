"""How a topic or message holds a quantity: the rows of which the tables of both formats consist."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from px4fuse.flight import Columns


@dataclass(frozen=True)
class Layout:
    """One way in which a quantity is written.

    Attributes
    ----------
    topic : str
        A PX4 topic or a MAVLink message.
    columns : mapping
        Our column name to the field's name, ``name[i]`` for an element; all must be present.
    optional : mapping
        Further columns, read where the topic has them.
    scale : mapping
        Our unit per unit of the field, by our column name; 1 where there is none.
    """

    topic: str
    columns: Mapping[str, str]
    optional: Mapping[str, str] = field(default_factory=dict)
    scale: Mapping[str, float] = field(default_factory=dict)


def elements(names: list[str], of: str, at: Iterable[int] = range(100)) -> dict[str, str]:
    """Columns that are elements of one field; all from the first on by default.

    >>> elements(["north_m", "east_m"], "position")
    {'north_m': 'position[0]', 'east_m': 'position[1]'}
    """
    return {name: f"{of}[{index}]" for name, index in zip(names, at, strict=False)}


def fields(columns: list[str], names: str) -> dict[str, str]:
    """Columns of some fields, whose names are separated by blanks.

    >>> fields(["north_m", "east_m"], "x y")
    {'north_m': 'x', 'east_m': 'y'}
    """
    return dict(zip(columns, names.split(), strict=True))


XYZ, VELOCITY = fields(Columns.POSITION, "x y z"), fields(Columns.VELOCITY, "vx vy vz")
POSITION_AND_VELOCITY = XYZ | VELOCITY
GLOBAL_COLUMNS = ["latitude_deg", "longitude_deg", "altitude_m"]
GLOBAL = fields(GLOBAL_COLUMNS, "lat lon alt")
# As integers
GLOBAL_SCALE = dict(zip(GLOBAL_COLUMNS, (1e-7, 1e-7, 1e-3), strict=True))
# Where the diagonal stands in the row-major upper triangle of a 6×6 matrix: x, y, z, and rotations
POSE_DIAGONAL, ROTATION_DIAGONAL = (0, 6, 11), (15, 18, 20)
