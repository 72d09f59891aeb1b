#!/usr/bin/env bash
# Run once, when the autograder is uploaded: a Python of its own, with the versions of the machine
# that wrote this, so that the numbers and pages are the same to the last digit.
set -euo pipefail
apt-get update
apt-get install -y python3-venv
python3 -m venv /opt/uv
/opt/uv/bin/pip install uv
/opt/uv/bin/uv venv --python $python /opt/px4fuse
/opt/uv/bin/uv pip install --python /opt/px4fuse/bin/python \
    --requirement /autograder/source/requirements.txt
