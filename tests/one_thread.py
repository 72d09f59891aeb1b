"""Set linear algebra to one thread, as in the commands; must be imported before NumPy."""

import os

from px4fuse.core.threads import ONE_THREAD_ENVIRONMENT

os.environ.update(ONE_THREAD_ENVIRONMENT)
