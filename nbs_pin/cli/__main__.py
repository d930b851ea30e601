"""`python -m nbs_pin.cli`."""

import sys

from nbs_pin.cli import main

sys.exit(main())
