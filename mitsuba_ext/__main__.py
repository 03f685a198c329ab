"""``python -m mitsuba_ext``: the command ``mitsuba-ext``."""

import sys

from .cli import main

sys.exit(main())
