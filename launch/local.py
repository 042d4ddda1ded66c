"""Starts local training: `python launch/local.py --config configs/memory.toml`, the same as `apex-bat train`."""

import sys

from apex_bat.cli import main

if __name__ == "__main__":
    sys.argv.insert(1, "train")
    sys.exit(main())
