"""Single-file web pages: a table page, and escaping of text from logs and students.

Data cannot execute: they are JSON without HTML characters, which the page's script inserts as text
nodes. The content security policy allows that script by its hash and no network access.
"""

from __future__ import annotations
