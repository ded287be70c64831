# For type checkers: `fgslam.errors` is another name of `fgslam.core.errors` (see `__init__.py`).
from fgslam.core.errors import *  # noqa: F403 - all of them, under another name
