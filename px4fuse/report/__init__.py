"""The report: PDF pages, terminal summary, results JSON."""

from px4fuse.plain import sentences

say = sentences(__file__)
