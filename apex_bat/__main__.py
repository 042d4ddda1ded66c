"""`python -m apex_bat`, the same as `apex-bat`."""

import sys

from apex_bat.cli import main

if __name__ == "__main__":
    sys.exit(main())
