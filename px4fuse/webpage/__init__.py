"""Web pages in one file: what makes text from logs and students inert, and the table.

Nothing from data can act: it is JSON in which an HTML parser finds nothing, which the page's
one script puts into the page as text, and that script is allowed by its hash. Nothing is loaded
from a network.
"""

from __future__ import annotations
