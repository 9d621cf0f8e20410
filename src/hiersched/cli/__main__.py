"""`python -m hiersched.cli` is `hiersched`."""

import sys

from hiersched.cli import main

sys.exit(main())
