"""Linear algebra in one thread, as commands do it; imported before NumPy, which reads it once."""

import os

from px4fuse.threads import ONE_THREAD

os.environ.update(ONE_THREAD)
