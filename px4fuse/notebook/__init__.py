"""What a notebook needs: the lab's commands with arguments, and results that show themselves.

Importing this package teaches every result its words, its table and its picture
(:mod:`px4fuse.display`).
"""

from typing import Any

from px4fuse.display import Shown, draw
from px4fuse.notebook import tables

__all__ = ["tables"]


@draw.register
def _(result: Shown, **options: Any) -> Any:
    from px4fuse.notebook.pictures import picture  # noqa: PLC0415 - matplotlib takes its time

    return picture(result, **options)
