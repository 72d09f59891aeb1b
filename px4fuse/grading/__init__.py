"""The instructor's side: reports that prove themselves, and a class graded.

What a student hands in is never trusted: it is read in bounded time and memory, nothing in it is
executed, and no path, formula or markup of it reaches the file system or a table live.
"""
