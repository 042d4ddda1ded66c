"""Starts training on a Ray cluster: `python launch/ray_cluster.py --config configs/memory.toml --set actors=64`.

The same as `apex-bat train --cluster auto`; see docs/cluster.md. Run it on a node of the cluster, or submit it:
`ray job submit --working-dir . -- python launch/ray_cluster.py --run /shared/runs/one --set actors=64`.
"""

import sys

from apex_bat.cli import main

if __name__ == "__main__":
    given = sys.argv[1:]
    cluster = [] if any(word.partition("=")[0] == "--cluster" for word in given) else ["--cluster", "auto"]
    sys.argv[1:] = ["train", *cluster, *given]
    sys.exit(main())
