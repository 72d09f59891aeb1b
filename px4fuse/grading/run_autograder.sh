#!/usr/bin/env bash
# Run for every submission: its PDF is read within bounds, and nothing in it is executed.
export PYTHONPATH=/autograder/source
exec /opt/px4fuse/bin/python -P -m px4fuse grade --gradescope /autograder$options
